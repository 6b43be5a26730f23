// Messages from the server to the page. A test generates this file from the server's types (messages/typescript.rs):
// VIZFLYT_WRITE_TYPES=1 cargo test -p vizflyt-server typescript

export type Arena = {
  body_radius_m: number;
  boot: string;
  cameras: {
    cx_px?: number;
    cy_px?: number;
    depth: boolean;
    distortion?: { k1: number; k2: number; k3: number; k4?: number; model: string; p1?: number; p2?: number };
    fx_px?: number;
    fy_px?: number;
    height_px: number;
    horizontal_fov_deg?: number;
    imaging?: { depth?: { model: string }; sensor?: string };
    intrinsics: {
      cx_px: number;
      cy_px: number;
      distortion: string | { BrownConrady: { k1: number; k2: number; k3: number; p1: number; p2: number } } | { KannalaBrandt: { k1: number; k2: number; k3: number; k4: number } };
      fx_px: number;
      fy_px: number;
      height_px: number;
      width_px: number;
    };
    name: string;
    near_m: number;
    position_m: [number, number, number];
    priority?: number;
    rate_hz?: number;
    roll_deg: number;
    tilt_deg: number;
    width_px: number;
    yaw_deg: number;
  }[];
  fence: {
    cuboid: {
      center_m: [number, number, number];
      half_m: [number, number, number];
      rotation: [number, number, number, number];
    };
  } | { capsule: { a_m: [number, number, number]; b_m: [number, number, number]; radius_m: number } } | { half_space: { normal: [number, number, number]; offset_m: number } } | { sphere: { center_m: [number, number, number]; radius_m: number } };
  goal_m: [number, number, number] | null;
  goal_radius_m: number;
  map_max_m: [number, number];
  map_min_m: [number, number];
  max_speed_mps: number;
  name: string;
  obstacles: { bits: string; cell_m: number; height: number; origin_m: [number, number]; width: number };
  stages: {
    center_m: [number, number, number];
    clearance_m?: number;
    height_m: number;
    name: string;
    normal: [number, number, number];
    polygon_m?: [number, number][];
    thickness_m?: number;
    width_m: number;
  }[];
  time_limit_s: number;
  twin_parts: number;
  type: "arena";
  vehicle: string;
  vehicles: string[];
};

export type Cameras = {
  cameras: {
    cx_px?: number;
    cy_px?: number;
    depth: boolean;
    distortion?: { k1: number; k2: number; k3: number; k4?: number; model: string; p1?: number; p2?: number };
    fx_px?: number;
    fy_px?: number;
    height_px: number;
    horizontal_fov_deg?: number;
    imaging?: { depth?: { model: string }; sensor?: string };
    intrinsics: {
      cx_px: number;
      cy_px: number;
      distortion: string | { BrownConrady: { k1: number; k2: number; k3: number; p1: number; p2: number } } | { KannalaBrandt: { k1: number; k2: number; k3: number; k4: number } };
      fx_px: number;
      fy_px: number;
      height_px: number;
      width_px: number;
    };
    name: string;
    near_m: number;
    position_m: [number, number, number];
    priority?: number;
    rate_hz?: number;
    roll_deg: number;
    tilt_deg: number;
    width_px: number;
    yaw_deg: number;
  }[];
  type: "cameras";
};

export type Track = {
  points: [number, number, number, number][];
  type: "track";
  vehicle: string;
};

export type Events = {
  events: {
    at_s: number;
    index: number;
    kind: string | {
      collision: {
        clearance_m: number;
        p_world_m: [number, number, number];
        speed_mps: number;
        with: string | { object: string } | { vehicle: string };
      };
    } | {
      geofence: {
        boundary: string | { no_fly: string };
        margin_m: number;
        overshoot_m: number;
        p_world_m: [number, number, number];
        speed_mps: number;
      };
    } | { ended: string | { pose_lost: { age_s: number } } | { time_asked: { seconds: number } } } | { finished: { seconds: number } } | { phase: string } | { pose_lost: { age_s: number } } | { stage: { index: number; name: string } } | { time_limit: { limit_s: number } };
    origin: string;
    stamp: number;
    text: string;
    tone: string | null;
  }[];
  type: "events";
};

export type State = {
  crash: number | null;
  encode: { max: number; p50: number; p90: number; p99: number };
  flight_s: number | null;
  images_late: number;
  landed: boolean;
  objects: {
    id: number;
    max_m: [number, number, number];
    min_m: [number, number, number];
    name: string;
    p_world_m: [number, number, number];
    q_xyzw: [number, number, number, number];
  }[];
  others: {
    flight_s: number | null;
    name: string;
    phase: string;
    pose: {
      age_s: number;
      p_world_m: [number, number, number];
      rotation: [number, number, number, number];
      v_world_mps: [number, number, number];
      yaw_rad: number;
    } | null;
  }[];
  outcome: { at_s: number; outcome: string; text: string; title: string; tone: string } | null;
  pose: {
    age_s: number;
    p_world_m: [number, number, number];
    rotation: [number, number, number, number];
    v_world_mps: [number, number, number];
    yaw_rad: number;
  } | null;
  quality: {
    age_ms: number | null;
    imu: boolean;
    innovation_sigmas: number;
    position_sigma_mm: number;
    rate_hz: number;
    resets: number;
    rotation_sigma_deg: number;
    sources: {
      believed: number;
      latency_ms: number;
      name: string;
      rate_hz: number;
      rejected: {
        clock: number;
        disagree: number;
        flip: number;
        frozen: number;
        invalid: number;
        jump: number;
        outlier: number;
        stale: number;
      };
      source: number;
    }[];
    speed_mps: number;
  };
  render: { max: number; p50: number; p90: number; p99: number };
  render_hz: number;
  renderer: { name: string; reason: string };
  report: {
    images: {
      age_ms_p50: number;
      age_ms_p99: number;
      delivered: number;
      plugin_ms_p50: number;
      rate_hz: number;
      skipped: number;
    };
    mavlink_packets: number;
    phase: string;
    setpoints_sent: number;
    v_setpoint_mps: [number, number, number];
    vehicle: {
      armed: boolean;
      battery_fraction: number;
      battery_v: number;
      mode: number;
      omega_body_radps: [number, number, number];
      p_world_m: [number, number, number];
      v_world_mps: [number, number, number];
      world_from_body: [number, number, number, number];
    };
  } | null;
  runtime: { address: string; program: string } | null;
  send: { max: number; p50: number; p90: number; p99: number };
  source: {
    bad_packets: number;
    lost_frames: number;
    occluded: number;
    poses: number;
    rejected: number;
    stale_packets: number;
    tags: { cameras: number; image_ms: number; rms_px: number; tags: number; view: string } | null;
  };
  source_hz: number;
  stream_hz: number;
  stream_mbit_s: number;
  type: "state";
};

export type Session = {
  by: string | null;
  password: boolean;
  role: string | null;
  token: string | null;
  vehicle: string | null;
};

export type VehicleLine = {
  cameras: string[];
  name: string;
  phase: string;
  runtime: string | null;
};

export type SensorLine = {
  enabled: boolean;
  kind: string;
  late: number;
  made: number;
  measures: {
    horizontal_fov_rad: number;
    max_range_m: number;
    min_range_m: number;
    rate_hz: number;
    vertical_fov_rad: number;
  };
  model: string;
  name: string;
  position_m: [number, number, number];
  sent: number;
  to_autopilot: boolean;
};

export type ReadingLine = {
  age_s: number;
  points_m: [number, number, number][];
  range_m: number | null;
  records: number;
  seq: number;
};

export type SceneChoice = {
  now: string | null;
  scenes: string[];
};

export type Environment = {
  cloud?: {
    center_m: [number, number, number];
    color: [number, number, number];
    drift_mps: [number, number, number];
    layer_m: [number, number];
    patch_m: number;
    patchiness: number;
    radius_m: number;
    visibility_m: number;
  };
  depth_loss?: boolean;
  exposure_ms?: number;
  flicker?: { depth: number; mains_hz: number; readout_ms: number };
  fog: [number, number, number];
  fog_visibility_m: number;
  lamps?: {
    color: [number, number, number];
    height_m: number;
    positions_m: [number, number, number][];
    reach_m: number;
    spacing_m: number;
  };
  light: [number, number, number];
  name: string | null;
  names: string[];
  own_light?: { color: [number, number, number]; cone_deg: number; reach_m: number };
  rain?: { lens_drops: number; rate_mmph: number; wind_mps: [number, number] };
  snow?: { rate_mmph: number; wind_mps: [number, number] };
  sun?: {
    azimuth_deg: number;
    behind_m: number;
    color: [number, number, number];
    elevation_deg: number;
    glare: number;
  };
};

export type Pairing = {
  news: string;
  open: { code: string; left_s: number; right: string; tries_left: number } | null;
  port: number;
};

export type LabDay = {
  arena: string;
  axes: { ask: string; seen: string; vehicle: string } | null;
  began_unix_ms: number;
  checks: {
    ask: string;
    at_unix_ms: number | null;
    by: string;
    check: string;
    evidence: string;
    how: string;
    state: string;
    title: string;
    todo: string;
    vehicle: string;
  }[];
  distances: { apart_m: number; first: string; second: string }[];
  is_instructor: boolean;
  now_unix_ms: number;
  order: { until: string; vehicles: string[] };
  queue: {
    booked_unix_ms: number;
    called_unix_ms: number | null;
    ended_unix_ms: number | null;
    id: number;
    is_own: boolean;
    passed_over: number;
    place: number | null;
    state: string;
    team: string;
    vehicle: string;
  }[];
  separation_m: number | null;
  story: { at_unix_ms: number; text: string }[];
  vehicles: {
    called: string | null;
    checked_in: string | null;
    is_ready: boolean;
    must_wait: string | null;
    name: string;
    phase: string;
    runtime: string | null;
  }[];
};

export type Leaderboard = {
  course: string;
  graded: {
    conditions: string;
    level: string;
    places: {
      conditions: string;
      finished: number;
      flights: number;
      grades: number;
      hash: string;
      level: string;
      mean_stages_passed: number;
      median_s: number | null;
      plugin_sha256: string;
      project: string;
      rank: number;
      score: number;
      stages: number;
      team: string;
    }[];
    project: string;
  }[];
  newest: {
    attempt: string;
    began_unix_ms: number;
    course: string;
    ended_unix_ms: number | null;
    id: string;
    min_clearance_m: number | null;
    outcome: string;
    penalty_s: number;
    seconds: number | null;
    stages: number;
    stages_passed: number;
    state: string;
    team: string | null;
    vehicle: string;
  }[];
  official: {
    rank: number;
    run: string;
    runs: number;
    seconds: number | null;
    stages: number;
    stages_passed: number;
    team: string;
  }[];
  practice: {
    rank: number;
    run: string;
    runs: number;
    seconds: number | null;
    stages: number;
    stages_passed: number;
    team: string;
  }[];
  vehicles: { attempt: string; flight_s: number | null; phase: string; team: string | null; vehicle: string }[];
};

export type CrashCard = {
  cause: string;
  clearance_svg: string;
  course: string;
  ended_unix_ms: number;
  events: { before_s: number; text: string }[];
  id: number;
  images: { before_s: number[]; camera: string }[];
  printed: string[];
  samples: {
    before_s: number;
    clearance_m: number | null;
    p_world_m: [number, number, number];
    v_world_mps: [number, number, number];
    yaw_rad: number;
  }[];
  title: string;
  top_height_m: number;
  top_svg: string;
  vehicle: string;
  verdict: {
    end: string | {
      collision: { clearance_m: number; p_world_m: [number, number, number]; speed_mps: number; with: string };
    } | { time_limit: { limit_s: number } };
    max_speed_mps: number;
    min_clearance_m: number | null;
    outcome: string;
    path_m: number;
    penalty_s: number;
    reason: string;
    score: number;
    seconds: number;
    stages: { name: string; passed_s: number | null }[];
    stages_passed: number;
  };
};

export type Stats = {
  connection: {
    bytes_sent: number;
    congestion_events: number;
    mbit_s: number;
    mtu: number;
    packets_lost: number;
    packets_sent: number;
    rtt_ms: number;
    seconds: number;
    window: number;
  } | null;
  images: {
    camera: string;
    delivered: number;
    drawn: number;
    skipped: {
      broken: number;
      failed: number;
      late: number;
      no_room: number;
      overrun: number;
      stale: number;
      superseded: number;
      unasked: number;
    };
    under_way: number;
  }[];
  pose: {
    age_ms: number | null;
    imu: boolean;
    innovation_sigmas: number;
    position_sigma_mm: number;
    rate_hz: number;
    resets: number;
    rotation_sigma_deg: number;
    sources: {
      believed: number;
      latency_ms: number;
      name: string;
      rate_hz: number;
      rejected: {
        clock: number;
        disagree: number;
        flip: number;
        frozen: number;
        invalid: number;
        jump: number;
        outlier: number;
        stale: number;
      };
      source: number;
    }[];
    speed_mps: number;
  };
  runtime: string | null;
  server: {
    encode: { max: number; p50: number; p90: number; p99: number };
    pose: { max: number; p50: number; p90: number; p99: number };
    render: { max: number; p50: number; p90: number; p99: number };
    send: { max: number; p50: number; p90: number; p99: number };
  };
  timing: {
    cameras: {
      arrived: number;
      broken: number;
      delivered: number;
      overrun: number;
      stale: number;
      superseded: number;
      unasked: number;
    }[];
    clock: {
      drift_bound_ppm: number;
      drift_ppm: number;
      error_bound_ms: number;
      offset_ns: number;
      steps: number;
    } | null;
    intervals: { bins: number[]; times: { max: number; p50: number; p90: number; p99: number } };
    seconds: number;
    waterfall: {
      age: { max: number; p50: number; p90: number; p99: number };
      answered: number;
      clamped: number;
      images: number;
      out_of_bound: number;
      stages: {
        decode: { max: number; p50: number; p90: number; p99: number };
        encode: { max: number; p50: number; p90: number; p99: number };
        handover: { max: number; p50: number; p90: number; p99: number };
        plugin: { max: number; p50: number; p90: number; p99: number };
        pose: { max: number; p50: number; p90: number; p99: number };
        receive: { max: number; p50: number; p90: number; p99: number };
        render: { max: number; p50: number; p90: number; p99: number };
        send: { max: number; p50: number; p90: number; p99: number };
        setpoint: { max: number; p50: number; p90: number; p99: number };
      };
      total: { max: number; p50: number; p90: number; p99: number };
    };
  } | null;
  vehicle: string;
};

export type Message = Arena | Cameras | Track | Events | State;
export type Camera = Cameras["cameras"][number];
export type EventLine = Events["events"][number];

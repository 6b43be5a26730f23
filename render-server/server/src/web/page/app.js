// The page: one WebSocket in, the stop button out. Everything shown is the newest; a lost
// connection comes back by itself, and what was last known stays on the screen.

import { CameraForm } from "/cameras.js";
import { ask, showOrders } from "/controls.js";
import { showCrash } from "/crash.js";
import { showLeaderboard } from "/leaderboard.js";
import { TopView } from "/map.js";

const $ = (id) => document.getElementById(id);
const view = new TopView($("map"));
const form = new CameraForm($("camera-form"), $("camera-said"));
/** The vehicle asked for; the first one, if none is. */
const wanted = new URLSearchParams(location.search).get("vehicle");
const shown = { vehicle: null, pose: null, state: null, camera: 0, cameras: [], boot: null, events: new Set(), outcome: null };

// ---- the view in space --------------------------------------------------------------------
let space = null;
function spaceStyle() {
  const css = getComputedStyle(document.documentElement);
  const read = (name) => css.getPropertyValue(name).trim();
  return {
    theme: document.documentElement.dataset.theme, text: read("--text"), accent: read("--accent"), good: read("--good"),
    warn: read("--warn"), bad: read("--bad"), muted: read("--muted"), floor: read("--floor"),
    solidLow: read("--solid-low"), solidHigh: read("--solid-high"),
  };
}
/** Shows the view in space, or the top view; fetches what draws it when it is first asked for. */
async function pickView(inSpace) {
  if (inSpace && !space) {
    try {
      const { SpaceView } = await import("/space.js");
      space = new SpaceView($("space"));
      if (shown.arena) space.setArena(shown.arena, spaceStyle());
    } catch {
      inSpace = false;
      $("view-space").disabled = true;
      $("view-space").title = "this browser has no WebGL 2";
    }
  }
  $("map").hidden = inSpace;
  $("space").hidden = !inSpace;
  $("view-top").setAttribute("aria-pressed", !inSpace);
  $("view-space").setAttribute("aria-pressed", inSpace);
  (inSpace ? space : view).resize();
}
for (const [id, inSpace] of [["view-top", false], ["view-space", true]])
  $(id).addEventListener("click", () => {
    localStorage.setItem("view", inSpace ? "space" : "top");
    pickView(inSpace);
  });
/** What was chosen last; else space, where a graphics card draws it. */
async function firstView() {
  const chosen = localStorage.getItem("view");
  pickView(chosen ? chosen === "space" : (await import("/space.js")).hasCard());
}

// ---- theme -------------------------------------------------------------------------------
const wantsLight = matchMedia("(prefers-color-scheme: light)");
function applyTheme() {
  const theme = localStorage.getItem("theme") ?? (wantsLight.matches ? "light" : "dark");
  document.documentElement.dataset.theme = theme;
  view.restyle();
  if (space && shown.arena) space.setArena(shown.arena, spaceStyle());
}
wantsLight.addEventListener("change", applyTheme);
$("theme").addEventListener("click", () => {
  localStorage.setItem("theme", document.documentElement.dataset.theme === "light" ? "dark" : "light");
  applyTheme();
});
applyTheme();

// ---- stop --------------------------------------------------------------------------------
const api = () => `/api/vehicles/${encodeURIComponent(shown.vehicle)}`;

/** Stops the vehicle shown, or all of them. */
async function stop(all = false) {
  const button = $(all ? "estop-all" : "estop");
  button.dataset.pressed = "";
  say("stopping");
  try {
    // Before the page knows whose it is, the button stops whoever flies.
    const where = all || shown.vehicle == null ? "/api/estop" : `${api()}/estop`;
    // Not through `order`: the stop button waits for nothing.
    let answer = await fetch(where, { method: "POST" });
    // The server is changing its scene: this connection is the former one's.
    for (let tries = 0; answer.status === 503 && tries < 20; tries++) {
      await new Promise((done) => setTimeout(done, 250));
      answer = await fetch(where, { method: "POST" });
    }
    say(await answer.text());
    if (!answer.ok) banner("warn", "Not stopped", $("said").textContent);
  } catch {
    banner("bad", "Not stopped", "the server cannot be reached: use the pilot's transmitter");
  }
  setTimeout(() => delete button.dataset.pressed, 400);
}
$("estop").addEventListener("click", () => stop());
$("estop-all").addEventListener("click", () => stop(true));
addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  // Space on another focused control is that control's own.
  const control = event.target.closest?.("button, input, select, summary, textarea");
  const elsewhere = control && control !== $("estop");
  if (event.code === "Escape" || (event.code === "Space" && !elsewhere)) {
    event.preventDefault();
    stop();
  }
});
function say(text) {
  $("said").textContent = text;
}

// ---- the connection ----------------------------------------------------------------------
let wait_ms = 250;
function connect() {
  const which = wanted == null ? "" : `?vehicle=${encodeURIComponent(wanted)}`;
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws${which}`);
  let opened = false;
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    opened = true;
    wait_ms = 250;
    link("good", "live");
    delete document.body.dataset.stale;
  };
  socket.onmessage = ({ data }) => (typeof data === "string" ? hear(JSON.parse(data)) : look(data));
  socket.onclose = () => {
    link("bad", "server gone, reconnecting");
    if (!opened) ask().then(({ role }) => role || link("warn", "not logged in"));
    document.body.dataset.stale = "";
    if (!opened && wanted != null) missing();
    setTimeout(connect, wait_ms);
    wait_ms = Math.min(3000, wait_ms * 1.6);
  };
}
/** Tells it if the vehicle asked for is not among those served. */
async function missing() {
  try {
    const vehicles = await (await fetch("/api/vehicles")).json();
    const names = vehicles.map((vehicle) => vehicle.name);
    if (names.includes(wanted)) return;
    link("warn", "no such vehicle");
    showVehicles(names, null);
    banner("warn", `No vehicle '${wanted}'`, `here fly ${names.join(", ")}`);
  } catch {
    // The server is gone: that is told already.
  }
}

/** Shows the vehicles to choose from, if there are several, or the one chosen is not there. */
function showVehicles(names, current) {
  const list = $("vehicles");
  const options = names.map((name) => new Option(name, name, false, name === current));
  if (current == null) options.unshift(new Option("choose a vehicle", "", true, true));
  list.replaceChildren(...options);
  list.hidden = options.length < 2;
  $("vehicle").hidden = !list.hidden;
  $("estop-all").hidden = names.length < 2;
  put("estop-what", names.length < 2 || current == null ? "" : current);
}
$("vehicles").addEventListener("change", ({ target }) => {
  if (target.value) location.search = `?vehicle=${encodeURIComponent(target.value)}`;
});

function link(tone, text) {
  $("link").dataset.tone = tone;
  $("link-text").textContent = text;
}

function hear(message) {
  ({ arena: hearArena, cameras: hearCameras, trail: hearTrail, events: hearEvents, state: hearState })[message.type]?.(message);
}

function hearArena(arena) {
  if (shown.boot !== arena.boot) {
    shown.boot = arena.boot;
    shown.events.clear();
    shown.outcome = null;
    shown.flown = 0;
    $("events").replaceChildren();
    $("outcome").hidden = true;
  }
  shown.vehicle = arena.vehicle;
  form.vehicle = api();
  document.title = `${arena.vehicle} · ${arena.name} · VizFlyt`;
  showVehicles(arena.vehicles, arena.vehicle);
  $("arena").textContent = arena.name;
  $("vehicle").textContent = arena.vehicle;
  shown.arena = arena;
  space?.setArena(arena, spaceStyle());
  showStages();
  $("speed-top").textContent = `${Math.max(1, arena.max_speed_mps)} m/s`;
  view.setArena(arena);
  shown.cameras = arena.cameras;
  const tabs = shown.cameras.map((camera, index) => {
    const tab = document.createElement("button");
    tab.type = "button";
    tab.textContent = camera.name;
    tab.onclick = () => pick(index);
    return tab;
  });
  $("camera-tabs").replaceChildren(...tabs);
  $("camera-tabs").hidden = tabs.length < 2;
  pick(Math.min(shown.camera, tabs.length - 1));
  function pick(index) {
    shown.camera = index;
    tabs.forEach((tab, k) => tab.setAttribute("aria-pressed", k === index));
    showCamera(false);
  }
}

function hearCameras({ cameras }) {
  shown.cameras = cameras;
  showCamera(true);
}

function showCamera(again) {
  const camera = shown.cameras[shown.camera];
  put("camera-name", camera ? `${camera.name} · ${camera.width_px} × ${camera.height_px}` : "");
  form.show(camera, again);
}

function hearTrail({ points }) {
  view.trail = points;
}

// ---- pictures ----------------------------------------------------------------------------
const busy = [false, false, false];
/** Which picture the second figure shows: 1 depth, 2 objects. */
let second = 1;
$("depth-kind").addEventListener("click", () => {
  second = second === 1 ? 2 : 1;
  put("depth-kind", second === 1 ? "depth" : "objects");
  $("depth-kind").setAttribute("aria-label", second === 1 ? "show objects instead of depth" : "show depth instead of objects");
  document.querySelector(".depth-scale").hidden = second !== 1;
});
async function look(data) {
  const [kind, camera] = new Uint8Array(data, 0, 2);
  if (camera !== shown.camera || busy[kind]) return;
  if (kind === 2) {
    $("depth-kind").hidden = false;
    $("depth-word").hidden = true;
  }
  if (kind !== 0 && kind !== second) return;
  busy[kind] = true;
  try {
    const image = await createImageBitmap(new Blob([new Uint8Array(data, 2)], { type: "image/jpeg" }));
    const canvas = $(kind === 0 ? "colour" : "depth");
    if (canvas.width !== image.width || canvas.height !== image.height)
      [canvas.width, canvas.height] = [image.width, image.height];
    canvas.getContext("2d").drawImage(image, 0, 0);
    image.close();
  } catch {
    // A picture that does not decode is followed by the next one.
  }
  busy[kind] = false;
}

// ---- events ------------------------------------------------------------------------------
const TONES = {
  collision: "bad", geofence: "bad", emergency_stop: "bad", plugin_failed: "bad", pose_lost: "bad",
  finished: "good", stage: "good", pose_regained: "good", time_limit: "warn", phase: "go",
  plugin_output: "code", note: "", start: "go", land: "warn",
};
const TITLES = {
  collision: "Collision", geofence: "Left the geofence", emergency_stop: "Stopped by hand",
  plugin_failed: "Plugin failed", pose_lost: "Pose lost", finished: "Finished", time_limit: "Time is up",
  land: "Landed by hand",
};
const kindOf = (kind) => (typeof kind === "string" ? kind : Object.keys(kind)[0]);
const clock = (s) => `${Math.floor(s / 60)}:${(s % 60).toFixed(1).padStart(4, "0")}`;

function hearEvents({ events }) {
  const list = $("events");
  for (const event of events) {
    if (shown.events.has(event.index)) continue;
    shown.events.add(event.index);
    const line = document.createElement("li");
    const time = document.createElement("time"), text = document.createElement("span");
    time.textContent = clock(event.at_s);
    text.textContent = event.text || kindOf(event.kind).replaceAll("_", " ");
    line.dataset.tone = TONES[kindOf(event.kind)] ?? "";
    line.append(time, text);
    list.append(line);
    if (kindOf(event.kind) === "stage" && view.arena?.stages[event.kind.stage.index]) {
      view.arena.stages[event.kind.stage.index].passed = true;
      showStages();
    }
  }
  while (list.childElementCount > 400) list.firstChild.remove();
  follow();
}

// The newest event stays in sight until someone scrolls up to read.
let following = true;
function follow() {
  if (following) $("events").scrollTop = $("events").scrollHeight;
}
$("events").addEventListener("scroll", ({ target }) => {
  following = target.scrollTop + target.clientHeight >= target.scrollHeight - 40;
});
new ResizeObserver(follow).observe($("events"));

for (const button of document.querySelectorAll("[data-feed]"))
  button.addEventListener("click", () => {
    $("events").dataset.feed = button.dataset.feed;
    for (const other of document.querySelectorAll("[data-feed]")) other.setAttribute("aria-pressed", other === button);
    follow();
  });

// ---- stages ------------------------------------------------------------------------------
/** A light for each stage of the course: passed, the next one, those after it. */
function showStages() {
  const stages = shown.arena?.stages ?? [];
  const next = stages.findIndex((stage) => !stage.passed);
  $("stages").hidden = !stages.length;
  $("stages").replaceChildren(
    ...stages.map((stage, k) => {
      const light = document.createElement("li");
      light.textContent = stage.name;
      light.dataset.light = stage.passed ? "passed" : k === next ? "next" : "";
      if (k === next) light.setAttribute("aria-current", "step");
      light.setAttribute("aria-label", `${stage.name}: ${stage.passed ? "passed" : k === next ? "next" : "to come"}`);
      return light;
    }),
  );
}

function banner(tone, title, text) {
  const box = $("outcome");
  box.hidden = false;
  box.dataset.tone = tone;
  if ($("outcome-title").textContent !== title) $("outcome-title").textContent = title;
  if ($("outcome-text").textContent !== text) $("outcome-text").textContent = text;
}

// ---- the state ---------------------------------------------------------------------------
const PHASES = {
  connecting: ["idle", "connecting"], preparing: ["warn", "preparing"], taking_off: ["go", "taking off"],
  flying: ["good", "flying"], holding: ["warn", "holding"], landing: ["warn", "landing"], landed: ["idle", "landed"],
  waiting: ["go", "ready to start"],
};
const lines = { altitude: [], speed: [], age: [] };
// Adding zero turns -0 into 0: a vehicle on the floor is not at "-0.00".
const fixed = (value, digits) => (Number.isFinite(value) ? (+value.toFixed(digits) + 0).toFixed(digits) : "–");
const put = (id, text) => {
  const node = $(id);
  if (node.textContent !== text) node.textContent = text;
};
const tone = (id, value) => ($(id).closest("div").dataset.tone = value);

function hearState(state) {
  shown.state = state;
  const now = performance.now();
  const { pose, report } = state;
  const live = pose && pose.age_s < 0.5;
  if (state.flight_s == null && shown.flown) {
    // A new flight on the same server: its trail starts afresh.
    view.trail = [];
    $("outcome").hidden = true;
    for (const stage of shown.arena?.stages ?? []) stage.passed = false;
    showStages();
  }
  shown.flown = state.flight_s != null;
  showOrders(shown.vehicle, state);
  if (pose) {
    shown.pose = { ...pose, received: live ? now : -1e9 };
    const speed = Math.hypot(...pose.v_world_mps);
    if (live) view.addPoint(pose.p_world_m, speed);
    put("altitude", fixed(pose.p_world_m[2], 2));
    put("speed", fixed(speed, 2));
    push("altitude", pose.p_world_m[2], now);
    push("speed", speed, now);
  }
  const [phaseTone, phaseText] = state.runtime
    ? PHASES[report?.phase ?? "connecting"] ?? PHASES.connecting
    : ["idle", state.landed ? "landed" : "no runtime"];
  $("phase").dataset.tone = phaseTone;
  put("phase-text", phaseText);
  put("clock", clock(state.flight_s ?? 0));
  const left_s = shown.arena?.time_limit_s > 0 && state.flight_s != null && !state.landed
    ? Math.max(0, shown.arena.time_limit_s - state.flight_s) : null;
  put("clock-left", left_s == null ? "" : `${Math.ceil(left_s)} s left`);

  const images = report?.images;
  put("age", images?.delivered ? fixed(images.age_ms_p50, 1) : "–");
  put("age99", images?.delivered ? `p99 ${fixed(images.age_ms_p99, 1)}` : "");
  tone("age", images?.age_ms_p99 > 80 ? "warn" : "");
  if (images?.delivered) push("age", images.age_ms_p50, now);
  put("rate", fixed(images?.delivered ? images.rate_hz : state.stream_hz, 0));
  put("mbit", state.stream_mbit_s > 0.05 ? `${fixed(state.stream_mbit_s, 1)} Mb/s` : "");
  put("render", state.render.p50 ? fixed(state.render.p50, 1) : "–");
  put("render99", state.render.p99 ? `p99 ${fixed(state.render.p99, 1)}` : "");

  const vehicle = report?.vehicle;
  const knows = vehicle && vehicle.battery_fraction >= 0 && vehicle.battery_v > 0;
  put("battery", knows ? fixed(vehicle.battery_fraction * 100, 0) : vehicle?.battery_v > 0 ? fixed(vehicle.battery_v, 1) : "–");
  put("battery-unit", knows || !(vehicle?.battery_v > 0) ? "%" : "V");
  put("volts", knows ? `${fixed(vehicle.battery_v, 1)} V` : "");
  tone("battery", knows && vehicle.battery_fraction < 0.15 ? "bad" : knows && vehicle.battery_fraction < 0.3 ? "warn" : "");

  put("poses", fixed(state.source_hz, 0));
  tone("poses", live ? "" : "bad");
  const { bad_packets, lost_frames, occluded } = state.source;
  const quality = state.quality;
  const tags = state.source.tags;
  $("tags-view").hidden = !tags?.view;
  if (tags?.view) $("tags-view").href = `//${tags.view}/`;
  const off = quality?.age_ms == null ? "" : `±${fixed(quality.position_sigma_mm, 1)} mm${quality.imu ? ", IMU" : ""}`;
  put("pose-note", !pose ? "no pose yet" : !live ? `lost ${fixed(pose.age_s, 1)} s`
    : bad_packets ? `${bad_packets} bad` : lost_frames ? `${lost_frames} lost` : occluded ? `${occluded} unseen` : off);
  $("pose-panel").title = (quality?.sources ?? []).map((source) => {
    const not = Object.entries(source.rejected).filter(([, count]) => count).map(([why, count]) => `${count} ${why}`);
    return `${source.name || `source ${source.source}`}: ${fixed(source.rate_hz, 0)} Hz, ${fixed(source.latency_ms, 1)} ms late, ` +
      `${source.believed} believed${not.length ? `, not: ${not.join(", ")}` : ""}`;
  }).concat(quality?.age_ms == null ? [] : [`innovation ${fixed(quality.innovation_sigmas, 1)} sigma, attitude ±${fixed(quality.rotation_sigma_deg, 2)}°, ${quality.resets} resets`])
    .concat(tags ? [`${tags.tags} tags in ${tags.cameras} cameras, corners ${fixed(tags.rms_px, 2)} px off, ${fixed(tags.image_ms, 1)} ms an image`] : []).join("\n");
  put("renderer", `renderer: ${state.renderer.name} (${state.renderer.reason})`);
  put("runtime", state.runtime ? `${state.runtime.program} at ${state.runtime.address}` : "no runtime connected");

  const hint = !pose ? "waiting for the first pose of the vehicle" : !state.runtime && !state.landed ? `waiting for a runtime: vizflyt fly PLUGIN --vehicle ${shown.vehicle} --server …` : "";
  $("hint").hidden = !hint;
  put("hint", hint);

  if (state.outcome) {
    const kind = kindOf(state.outcome.kind);
    const ended = state.landed ? "; the vehicle has landed" : "";
    banner(TONES[kind] || "warn", TITLES[kind] ?? kind, state.outcome.text + ended);
  }
  showCrash(api(), state.crash);
  // Whoever looks from across the room sees it, too.
  document.body.dataset.outcome = state.outcome ? TONES[kindOf(state.outcome.kind)] || "warn" : "";
  // When the vehicle changes, a flight is decided, and when it has landed: the standings may be others.
  const decided = `${shown.vehicle} ${state.outcome?.stamp_ns ?? state.outcome?.text} ${state.landed}`;
  if (decided !== shown.decided) showLeaderboard(shown.vehicle);
  shown.decided = decided;
  shown.outcome = state.outcome;
}

// ---- drawing -----------------------------------------------------------------------------
const SPAN_MS = 30000;
function push(name, value, now) {
  const line = lines[name];
  line.push([now, value]);
  while (line.length && line[0][0] < now - SPAN_MS) line.shift();
}

function drawLine(name, now, colour) {
  const canvas = $(`${name}-line`), line = lines[name];
  const ratio = Math.min(2, devicePixelRatio || 1);
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(w * ratio)) [canvas.width, canvas.height] = [Math.round(w * ratio), Math.round(h * ratio)];
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, w, h);
  if (line.length < 2) return;
  const top = Math.max(...line.map((p) => p[1]), 1e-3) * 1.15;
  const span = Math.max(5000, Math.min(SPAN_MS, now - line[0][0]));
  const at = ([t, v]) => [w - ((now - t) / span) * w, h - 3 - (Math.max(0, v) / top) * (h - 12)];
  const fade = g.createLinearGradient(0, 0, w, 0);
  fade.addColorStop(0, "transparent");
  fade.addColorStop(0.5, colour);
  g.beginPath();
  line.forEach((p, k) => (k ? g.lineTo(...at(p)) : g.moveTo(...at(p))));
  g.strokeStyle = fade;
  g.lineWidth = 1.6;
  g.stroke();
  g.lineTo(w, h);
  g.lineTo(at(line[0])[0], h);
  g.closePath();
  g.globalAlpha = 0.14;
  g.fillStyle = fade;
  g.fill();
  g.globalAlpha = 1;
}

let lines_at = 0;
function frame(now) {
  const crashed = ["collision", "geofence"].includes(shown.outcome && kindOf(shown.outcome.kind));
  if ($("space").hidden) view.draw(shown.pose, now, crashed, shown.state?.objects);
  else space.draw({ pose: shown.pose, now, crashed, trail: view.trail, objects: shown.state?.objects });
  if (now - lines_at > 100 && view.style) {
    lines_at = now;
    for (const name of Object.keys(lines)) drawLine(name, now, view.style.accent);
  }
  requestAnimationFrame(frame);
}

firstView();
connect();
requestAnimationFrame(frame);

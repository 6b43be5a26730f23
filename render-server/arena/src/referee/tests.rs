use glam::{DQuat, Quat, Vec3};
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::messages::Limits;

use super::*;
use crate::DistanceField;
use crate::config::{
    BodyPart, EnvironmentConfig, Geofence, Goal, NoFly, Occupancy, RulesConfig, Spawn,
};
use crate::occupancy::{BakeSpec, Ellipsoid, OccupancyGrid};
use crate::pose::PoseConfig;

/// Returns an arena of 12 x 6 x 4 m, start at the origin, goal at x = 8, no stages.
pub(crate) fn arena() -> ArenaConfig {
    ArenaConfig {
        name: "test".into(),
        scene: "scene.ply".into(),
        body_radius_m: 0.12,
        takeoff_height_m: 1.0,
        time_limit_s: 20.0,
        ground_truth: true,
        attitude_rate: false,
        spawn: Spawn { position_m: DVec3::ZERO, yaw_deg: 0.0 },
        goal: Some(Goal { position_m: DVec3::new(8.0, 0.0, 1.0), radius_m: 0.5 }),
        geofence: Geofence {
            min_m: DVec3::new(-2.0, -3.0, -0.5),
            max_m: DVec3::new(10.0, 3.0, 4.0),
        },
        limits: Limits::new(6.0, 8.0),
        body: Vec::new(),
        no_fly: Vec::new(),
        occupancy: Occupancy { voxel_m: 0.1, ..Occupancy::default() },
        environment: EnvironmentConfig::default(),
        pose: PoseConfig::default(),
        sensors: Vec::new(),
        vehicles: Vec::new(),
        localization: Vec::new(),
        cameras: Vec::new(),
        stages: Vec::new(),
        objects: Vec::new(),
        rules: RulesConfig::default(),
    }
}

/// Returns a referee of the arena with a post at (4, 1), radius about 0.2 m, up to 3 m.
fn referee(config: &ArenaConfig) -> Referee {
    let post = (0..60).flat_map(|layer| {
        (0..12).map(move |side| {
            let angle = side as f32 * std::f32::consts::TAU / 12.0;
            Ellipsoid {
                center_m: Vec3::new(
                    4.0 + 0.18 * angle.cos(),
                    1.0 + 0.18 * angle.sin(),
                    layer as f32 * 0.05,
                ),
                scales_m: Vec3::splat(0.05),
                rotation: Quat::IDENTITY,
                opacity: 0.95,
            }
        })
    });
    Referee::new(config, DistanceField::of(OccupancyGrid::bake(post, &BakeSpec::of(config))))
}

/// Flies straight lines through the points at a speed, at 200 Hz; returns all events.
fn fly(referee: &mut Referee, way: &[[f64; 3]], speed_mps: f64, start_s: f64) -> Vec<Event> {
    let (mut events, mut t_s) = (Vec::new(), start_s);
    for pair in way.windows(2) {
        let (a, b) = (DVec3::from(pair[0]), DVec3::from(pair[1]));
        let ticks = ((b - a).length() / speed_mps * 200.0).ceil().max(1.0) as usize;
        for tick in 0..ticks {
            let p = a.lerp(b, tick as f64 / ticks as f64);
            t_s += 0.005;
            let stamp = ServerTime::from_ns(0).plus_seconds(t_s);
            let measured = Measured::new(stamp, Pose::new(p, DQuat::IDENTITY));
            match referee.handle_measurement(&measured) {
                // No vehicle turns a corner at full speed: the first pose behind a corner may be an outlier.
                Ok(_) | Err(Rejected::Outlier(_)) => {}
                Err(reason) => panic!("{reason}"),
            }
            events.extend(std::iter::from_fn(|| referee.poll_event()));
        }
    }
    events
}

fn check(way: &[[f64; 3]], speed_mps: f64, expected: impl Fn(&[Event]) -> bool) {
    let events = fly(&mut referee(&arena()), way, speed_mps, 1.0);
    assert!(expected(&events), "{events:?}");
}

#[test]
fn flight_without_faults_finishes_once() {
    let way = [[0., 0., 0.], [0., 0., 1.], [8.5, 0., 1.], [5., 0., 1.], [8., 0., 1.], [8., 0., 0.]];
    check(
        &way,
        2.0,
        |events| matches!(events, [Event { kind: EventKind::Finished { seconds }, .. }] if (3.0..5.0).contains(seconds)),
    );
}

#[test]
fn collision_ends_the_flight() {
    let way = [[0., 0., 0.], [0., 1., 1.], [7.5, 1., 1.], [8., 0., 1.]];
    check(&way, 3.0, |events| {
        let [Event { kind: EventKind::Collision(collision), text, .. }] = events else {
            return false;
        };
        let Collision { p_world_m, with: Obstacle::Scene, .. } = collision else { return false };
        // Post radius and body radius, within a voxel and a half.
        text.contains("collision") && ((4.0 - 0.23 - 0.12) - p_world_m.x).abs() < 0.15
    });
}

#[test]
fn reports_leaving_the_fence_and_being_unable_to_stop_before_it() {
    let way = [[0., 0., 0.], [0., 0., 1.], [0., -3.5, 1.]];
    let breach = |events: &[Event]| {
        matches!(events.last(), Some(Event { kind: EventKind::Geofence(_), .. }))
    };
    check(&way, 0.5, |events| {
        breach(events) && events.iter().any(|event| event.text.contains("close to the geofence"))
    });
    check(&way, 6.0, |events| {
        breach(events) && events.last().unwrap().text.contains("cannot stop")
    });
}

#[test]
fn reports_no_fly_boxes_and_the_ceiling() {
    let mut config = arena();
    let corners = (DVec3::new(3.0, -2.0, 0.0), DVec3::new(3.2, -1.0, 2.0));
    config.no_fly.push(NoFly { name: "shelf".into(), min_m: corners.0, max_m: corners.1 });
    let way = [[0., 0., 0.], [0., -1.5, 1.], [5., -1.5, 1.]];
    for (speed_mps, expected) in [(0.5, "beyond the no-fly box shelf"), (3.0, "cannot stop before")]
    {
        let events = fly(&mut referee(&config), &way, speed_mps, 1.0);
        let Some(Event { kind: EventKind::Geofence(breach), text, .. }) = events.last() else {
            panic!("{events:?}")
        };
        assert!(text.contains(expected) && breach.p_world_m.x < 3.0, "{text}");
    }
    config.limits.max_altitude_m = Some(1.5);
    let events = fly(&mut referee(&config), &[[0., 0., 0.], [0., 0., 2.]], 0.5, 1.0);
    assert!(events.last().unwrap().text.contains("beyond the ceiling"), "{events:?}");
}

#[test]
fn arms_pass_along_the_post_and_collide_across_it() {
    let mut config = arena();
    config.body_radius_m = 0.4;
    let arm = DVec3::X * 0.35;
    config.body.push(BodyPart { from_m: -arm, to_m: Some(arm), radius_m: 0.04 });
    // 0.45 m from the post's centre, arms along the path.
    let way = [[0., 0., 0.], [0., 0.55, 1.], [7.5, 0.55, 1.]];
    assert!(fly(&mut referee(&config), &way, 2.0, 1.0).is_empty());
    config.body[0] =
        BodyPart { from_m: DVec3::Y * -0.35, to_m: Some(DVec3::Y * 0.35), radius_m: 0.04 };
    let events = fly(&mut referee(&config), &way, 2.0, 1.0);
    assert!(events[0].text.contains("collision"), "{events:?}");
}

#[test]
fn falling_is_a_crash_and_landing_is_not() {
    let settle = [[0., 0., 0.], [0., 0., 1.], [0., 0., 0.]];
    check(&settle, 0.5, <[Event]>::is_empty);
    let fall = [[0., 0., 0.], [0., 0., 2.], [0., 0., 0.]];
    check(&fall, 4.0, |events| events.len() == 1 && events[0].text.contains("the floor"));
}

#[test]
fn nothing_is_judged_on_the_floor() {
    // Carried by hand along the floor, out of the fence.
    check(&[[0., 0., 0.], [0., -4., 0.1]], 1.0, <[Event]>::is_empty);
}

#[test]
fn lost_pose_ends_the_flight_and_restart_begins_another() {
    let mut referee = referee(&arena());
    assert!(fly(&mut referee, &[[0., 0., 0.], [0., 0., 1.], [1., 0., 1.]], 2.0, 1.0).is_empty());
    // A warning first; then the flight is over, and its time limit too.
    let due = referee.poll_timeout().unwrap();
    referee.handle_timeout(due);
    let lost = referee.poll_event().unwrap();
    assert!(matches!(lost.kind, EventKind::PoseLost { .. }), "{lost:?}");
    let due = referee.poll_timeout().unwrap();
    referee.handle_timeout(due);
    let ended = referee.poll_event().unwrap();
    assert!(
        matches!(ended.kind, EventKind::Ended(EndReason::PoseLost { age_s }) if age_s >= 0.5),
        "{ended:?}"
    );
    assert_eq!(referee.poll_timeout(), None);
    referee.handle_timeout(due.plus_seconds(60.0));
    assert_eq!(referee.poll_event(), None, "no clock runs out on the ground");
    referee.restart();
    let way = [[1., 0., 0.], [1., 0., 1.], [8., 0., 1.]];
    let events = fly(&mut referee, &way, 2.0, 40.0);
    let kinds: Vec<_> = events.iter().map(|event| &event.kind).collect();
    assert!(
        matches!(kinds[..], [EventKind::PoseRegained, EventKind::Finished { .. }]),
        "{events:?}"
    );
}

fn received(kind: EventKind) -> Event {
    Event { stamp: ServerTime::ZERO, kind, text: bounded("") }
}

const UP: [[f64; 3]; 3] = [[0., 0., 0.], [0., 0., 1.], [1., 0., 1.]];

#[test]
fn time_limit_ends_the_flight() {
    let mut referee = referee(&arena());
    let hover = [[0., 0., 0.], [0., 0., 1.], [1., 0., 1.], [-1., 0., 1.], [1., 0., 1.]];
    let events = fly(&mut referee, &hover, 0.25, 1.0);
    let [Event { kind: EventKind::TimeLimit { limit_s }, text, .. }] = &events[..] else {
        panic!("{events:?}")
    };
    assert_eq!((*limit_s, text.as_str()), (20.0, "the course's 20 s are over"));
}

#[test]
fn after_land_only_collisions_are_reported() {
    for order in
        [EventKind::Land, EventKind::EmergencyStop, EventKind::Ended(EndReason::PluginLanded)]
    {
        let mut referee = referee(&arena());
        fly(&mut referee, &UP, 2.0, 1.0);
        referee.handle_event(&received(order));
        assert!(fly(&mut referee, &[[1., 0., 1.], [8., 0., 1.]], 2.0, 2.0).is_empty(), "no finish");
        let post = [[8., 0., 1.], [8., 1., 1.], [3., 1., 1.]];
        let events = fly(&mut referee, &post, 2.0, 5.6);
        assert!(matches!(&events[..], [Event { kind: EventKind::Collision(_), .. }]), "{events:?}");
    }
    // On the ground, nothing is checked, wherever the vehicle is carried.
    let mut referee = referee(&arena());
    fly(&mut referee, &UP, 2.0, 1.0);
    referee.handle_event(&received(EventKind::Phase(FlightPhase::Landed)));
    assert!(fly(&mut referee, &[[1., 0., 1.], [1., -4., 1.]], 2.0, 2.0).is_empty());
    referee.handle_timeout(ServerTime::ZERO.plus_seconds(99.0));
    let after: Vec<_> = std::iter::from_fn(|| referee.poll_event()).collect();
    assert!(matches!(&after[..], [Event { kind: EventKind::PoseLost { .. }, .. }]), "{after:?}");
}

#[test]
fn carrying_the_vehicle_before_take_off_does_not_count() {
    let mut referee = referee(&arena());
    // Carried into the post.
    let events = fly(&mut referee, &[[0., 1., 0.], [0., 1., 1.], [4., 1., 1.]], 2.0, 1.0);
    assert!(matches!(&events[..], [Event { kind: EventKind::Collision(_), .. }]), "{events:?}");
    referee.handle_event(&received(EventKind::Phase(FlightPhase::TakingOff)));
    let events = fly(&mut referee, &[[0., 0., 0.], [0., 0., 1.], [8., 0., 1.]], 2.0, 10.0);
    assert!(matches!(events.last().unwrap().kind, EventKind::Finished { .. }), "{events:?}");
}

#[test]
fn pose_jump_through_an_obstacle_is_not_a_collision() {
    let mut referee = referee(&arena());
    fly(&mut referee, &[[0., 0., 0.], [0., 1., 1.], [2., 1., 1.]], 2.0, 1.0);
    let newest_s = referee.newest().unwrap().stamp.seconds_since(ServerTime::ZERO);
    // From one side of the post to the other in one packet, and stays there.
    let mut events = Vec::new();
    for packet in 1..=40 {
        let stamp = ServerTime::ZERO.plus_seconds(newest_s + 0.005 * f64::from(packet));
        // Poses in the air never repeat.
        let noise_m = 1e-5 * f64::from(packet % 3);
        let beyond = Pose::new(DVec3::new(6.0 + noise_m, 1.0, 1.0), DQuat::IDENTITY);
        let _ = referee.handle_measurement(&Measured::new(stamp, beyond));
        events.extend(std::iter::from_fn(|| referee.poll_event()));
    }
    let [Event { kind: EventKind::Note, text, .. }] = &events[..] else { panic!("{events:?}") };
    assert!(text.starts_with("the pose jumped by 3.96 m and 0 degrees and stayed there"), "{text}");
    assert_eq!(referee.newest().unwrap().resets, 1, "the new position is accepted in the end");
}

/// Returns a referee whose vehicle hovers 1 m above the floor, and the time and position of its last pose.
/// [s], [m, world]
fn hovering(hz: f64) -> (Referee, f64, DVec3) {
    let mut referee = referee(&arena());
    fly(&mut referee, &[[0., 0., 0.], [0., 0.5, 1.]], 2.0, 1.0);
    referee.handle_event(&received(EventKind::Phase(FlightPhase::Flying)));
    let mut t_s = referee.newest().unwrap().stamp.seconds_since(ServerTime::ZERO);
    let mut p_m = DVec3::ZERO;
    for index in 0..(2.0 * hz) as u32 {
        t_s += 1.0 / hz;
        let noise_m = 1e-5 * f64::from(index % 3);
        // The stop was hard: its first poses may be outliers.
        p_m = DVec3::new(noise_m, 0.5, 1.0);
        let _ = send(&mut referee, t_s, p_m);
    }
    while referee.poll_event().is_some() {}
    (referee, t_s, p_m)
}

fn send(referee: &mut Referee, t_s: f64, p_m: DVec3) -> Result<PoseSample, Rejected> {
    let stamp = ServerTime::ZERO.plus_seconds(t_s);
    let sent = referee.handle_measurement(&Measured::new(stamp, Pose::new(p_m, DQuat::IDENTITY)));
    // As in the pose thread: the stamp of an accepted pose is the time.
    referee.handle_timeout(sent.as_ref().map_or(stamp, |sample| sample.stamp));
    sent
}

#[test]
fn repeated_poses_of_a_hover_are_lost_as_no_poses_are() {
    for (hz, origin) in [(200.0, false), (50.0, false), (10.0, false), (200.0, true), (10.0, true)]
    {
        let (mut referee, since_s, last_m) = hovering(hz);
        let last = *referee.newest().unwrap();
        let p_m = if origin { DVec3::ZERO } else { last_m };
        let mut events = Vec::new();
        for index in 1..=(4.0 * hz) as u32 {
            let t_s = since_s + f64::from(index) / hz;
            let _ = send(&mut referee, t_s, p_m);
            events.extend(std::iter::from_fn(|| referee.poll_event()).map(|event| (t_s, event)));
            assert_eq!(referee.newest(), Some(&last), "{hz} Hz, {index}");
        }
        let [(lost_s, lost), (end_s, end)] = &events[..] else { panic!("{hz} Hz: {events:?}") };
        assert!(matches!(lost.kind, EventKind::PoseLost { .. }), "{lost:?}");
        let why = if origin { "not visible" } else { "repeat bit for bit" };
        assert!(lost.text.contains(why), "{}", lost.text);
        let due_s = 0.15 + f64::from(last.allowance_s);
        assert!(
            (due_s..due_s + 1.01 / hz + 1e-6).contains(&(lost_s - since_s)),
            "{hz} Hz: {lost_s}"
        );
        let ended = EventKind::Ended(EndReason::PoseLost { age_s: 0.5 });
        assert_eq!(std::mem::discriminant(&end.kind), std::mem::discriminant(&ended), "{end:?}");
        assert!((0.5..0.5 + 1.01 / hz + 1e-6).contains(&(end_s - since_s)), "{hz} Hz: {end_s}");
        // The object is visible again: its second pose is the first that is known to be a measurement.
        let back_s = since_s + 4.0 + 1.0 / hz;
        send(&mut referee, back_s, DVec3::new(0.1, 0.5, 1.0)).unwrap();
        assert_eq!(referee.newest(), Some(&last));
        send(&mut referee, back_s + 1.0 / hz, DVec3::new(0.1001, 0.5, 1.0)).unwrap();
        let back = referee.poll_event().unwrap();
        assert!(matches!(back.kind, EventKind::PoseRegained), "{back:?}");
    }
}

#[test]
fn poses_of_a_vehicle_at_rest_on_the_ground_may_repeat() {
    use FlightPhase::{Connecting, Landed, Preparing, TakingOff, Waiting};
    for phase in
        [None, Some(Connecting), Some(Preparing), Some(Waiting), Some(TakingOff), Some(Landed)]
    {
        for p_m in [DVec3::ZERO, DVec3::new(1.0, 0.5, 0.01)] {
            let mut referee = referee(&arena());
            if let Some(phase) = phase {
                referee.handle_event(&received(EventKind::Phase(phase)));
            }
            for index in 0..1000 {
                send(&mut referee, 1.0 + 0.01 * f64::from(index), p_m).unwrap();
            }
            assert_eq!(referee.poll_event(), None, "{phase:?}");
        }
    }
}

/// Returns a referee with a door that slides through (4, 0) along y, 1 m to each side in 4 s, at the left when
/// it starts.
fn with_door(config: &mut ArenaConfig) -> Referee {
    use crate::config::{MotionConfig, ObjectConfig};
    use crate::grid::Grid;
    use crate::objects::MovingObjects;
    use crate::occupancy::occupancy_of;
    use vizflyt_protocol::geometry::Volume;

    config.objects.push(ObjectConfig {
        name: "door".into(),
        scene: "door.ply".into(),
        position_m: DVec3::new(4.0, 0.0, 0.0),
        yaw_deg: 0.0,
        phase_s: Some(1.0),
        motion: Some(MotionConfig::Oscillation {
            slide_m: DVec3::Y,
            axis: DVec3::ZERO,
            swing_deg: 0.0,
            period_s: 4.0,
        }),
    });
    let leaf = Volume::aabb(DVec3::new(-0.05, -0.4, 0.0), DVec3::new(0.05, 0.4, 2.0));
    let grid = Grid::covering(DVec3::new(-0.5, -0.9, -0.5), DVec3::new(0.5, 0.9, 2.5), 0.025);
    let own = occupancy_of(grid, -1e4, |p| leaf.signed_distance_m(p) < 0.0);
    let empty = OccupancyGrid::bake([], &BakeSpec::of(config));
    let objects = MovingObjects::new(config, 0);
    let still = DistanceField::of(empty).into();
    let obstacles = Obstacles::new(still, vec![DistanceField::of(own).into()], objects);
    // The objects' clock starts two seconds after the server's.
    Referee::new(config, obstacles).counting_from(ServerTime::from_ns(2_000_000_000))
}

#[test]
fn door_moves_by_the_epoch() {
    // Up, then along x past the door, which is reached 2 s after the start. The door is in the middle at 3, 5,
    // 7 s of the server's clock, and out of the path in between.
    let way = [[0., 0., 0.], [0., 0., 1.], [8., 0., 1.]];
    for (start_s, meets) in [(1.0, true), (3.0, true), (2.0, false), (4.0, false)] {
        let mut referee = with_door(&mut arena());
        let events = fly(&mut referee, &way, 2.5, start_s);
        let hit = events.iter().find(|e| matches!(e.kind, EventKind::Collision(_)));
        assert_eq!(hit.is_some(), meets, "start {start_s} s: {events:?}");
        if let Some(hit) = hit {
            assert!(hit.text.contains("collision with 'door' at (3.8"), "{}", hit.text);
        }
    }
}

#[test]
fn another_vehicle_is_an_obstacle() {
    let config = arena();
    let mut referee = referee(&config);
    let there = Pose::new(DVec3::new(5.0, -1.0, 1.0), DQuat::IDENTITY);
    let motion = Motion::at_rest(ServerTime::from_ns(0), there);
    let bee = Neighbour { name: bounded("bee"), motion, radius_m: 0.12 };
    referee.handle_neighbour(1, Some(bee));
    let events = fly(&mut referee, &[[0., -1., 0.], [0., -1., 1.], [8., -1., 1.]], 2.0, 0.0);
    let hit = events.iter().find(|event| matches!(event.kind, EventKind::Collision(_)));
    let text = &hit.expect("the bee").text;
    assert!(text.contains("collision with vehicle 'bee' at (4.7"), "{text}");
}

#[test]
fn excluded_imu_is_reported_with_probable_causes() {
    let mut referee = referee(&arena());
    let at = |s: f64| ServerTime::from_ns(0).plus_seconds(s);
    for i in 0..1000 {
        let t = 1.0 + 0.005 * f64::from(i);
        let turned = Pose::new(DVec3::ZERO, DQuat::from_rotation_z(2.0 * t));
        let _ = referee.handle_measurement(&Measured::new(at(t), turned));
        // The IMU's z axis is configured as another axis.
        let (accel_mps2, gyro_radps) = (DVec3::X * 9.81, DVec3::X * 2.0);
        referee.handle_imu(&ImuReading { stamp: at(t + 0.001), accel_mps2, gyro_radps });
    }
    let texts: Vec<_> =
        std::iter::from_fn(|| referee.poll_event()).map(|event| event.text).collect();
    let told = texts.iter().find(|text| text.contains("is left out")).expect("no event");
    assert!(told.contains("turned against the autopilot"), "{told}");
    assert!(told.ends_with("or does the vehicle shake?"), "text was truncated: {told}");
}

/// Returns the arena without a post, seen only west of x = 6 m.
fn half_seen(config: &ArenaConfig) -> DistanceField {
    use crate::seen::{ScenePlace, SeenSpace};
    let spec = BakeSpec::of(config);
    let (grid, [_, ny, nz]) = (spec.grid, spec.grid.size);
    let mut bits = vec![0u8; grid.voxels().div_ceil(8)];
    for n in 0..grid.voxels() {
        let center_m = grid.center_m([n / (ny * nz), n / nz % ny, n % nz]);
        bits[n / 8] |= u8::from(center_m.x < 6.0) << (n % 8);
    }
    let place = ScenePlace::of(&config.scene);
    let seen = SeenSpace::new(grid, place, [0; 32], bits);
    DistanceField::of(OccupancyGrid::bake_with([], &spec, Some(seen.at(&place)), &|_| ()))
}

#[test]
fn flight_into_unseen_space_is_a_collision() {
    let config = arena();
    let mut referee = Referee::new(&config, half_seen(&config));
    let events = fly(&mut referee, &[[0., 0., 0.], [0., 0., 1.], [8., 0., 1.]], 2.0, 1.0);
    let [Event { kind: EventKind::Collision(collision), text, .. }] = &events[..] else {
        panic!("{events:?}");
    };
    assert_eq!(collision.with, Obstacle::Unseen);
    assert!((collision.p_world_m.x - (6.0 - 0.12)).abs() < 0.1, "{collision:?}");
    assert!(text.contains("space that the capture has not seen"), "{text}");
}

#[test]
fn check_reports_unseen_goal_and_start_box() {
    let mut config = arena();
    config.rules.start_box = Some(crate::config::Geofence {
        min_m: DVec3::new(5.5, -0.5, 0.4),
        max_m: DVec3::new(6.5, 0.5, 1.0),
    });
    let checked = crate::check::check(&config, &half_seen(&config).into());
    let keys: Vec<&str> = checked.findings.iter().map(|finding| finding.key.as_str()).collect();
    assert_eq!(keys, ["rules.start_box", "goal.position_m"]);
    assert!(checked.findings[0].text.starts_with("50 % of the start box"), "{checked:?}");
    // An unseen start is found too.
    config.spawn.position_m.x = 7.0;
    let checked = crate::check::check(&config, &half_seen(&config).into());
    assert!(checked.findings[0].text.contains("touches unseen space"), "{checked:?}");
}

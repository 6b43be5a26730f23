use glam::{DQuat, Quat, Vec3};

use super::*;
use crate::config::{Geofence, Goal, Occupancy, Spawn};
use crate::occupancy::{BakeSpec, Ellipsoid, OccupancyGrid};

/// A room of 12 x 6 x 4 m, start at the origin, goal at x = 8, no stages.
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
        occupancy: Occupancy { voxel_m: 0.1, ..Occupancy::default() },
        vehicles: Vec::new(),
        cameras: Vec::new(),
        stages: Vec::new(),
    }
}

/// The room with a post at (4, 1) of radius about 0.2 m, up to 3 m.
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

/// Flies straight lines through the points at a speed, 200 Hz; returns every event's kind.
fn fly(referee: &mut Referee, way: &[[f64; 3]], speed_mps: f64, start_s: f64) -> Vec<Event> {
    let (mut events, mut t_s) = (Vec::new(), start_s);
    for pair in way.windows(2) {
        let (a, b) = (DVec3::from(pair[0]), DVec3::from(pair[1]));
        let ticks = ((b - a).length() / speed_mps * 200.0).ceil().max(1.0) as usize;
        for tick in 0..ticks {
            let p = a.lerp(b, tick as f64 / ticks as f64);
            t_s += 0.005;
            let stamp = ServerTime::from_ns(0).plus_seconds(t_s);
            referee.handle_measurement(stamp, Pose::new(p, DQuat::IDENTITY)).unwrap();
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
fn a_clean_flight_finishes_once() {
    let way = [[0., 0., 0.], [0., 0., 1.], [8.5, 0., 1.], [5., 0., 1.], [8., 0., 1.], [8., 0., 0.]];
    check(
        &way,
        2.0,
        |events| matches!(events, [Event { kind: EventKind::Finished { seconds }, .. }] if (3.0..5.0).contains(seconds)),
    );
}

#[test]
fn the_post_is_hit_and_nothing_after_it_counts() {
    let way = [[0., 0., 0.], [0., 1., 1.], [7.5, 1., 1.], [8., 0., 1.]];
    check(&way, 3.0, |events| {
        let [Event { kind: EventKind::Collision { p_world_m, .. }, text, .. }] = events else {
            return false;
        };
        // Post radius and body together, to a voxel and a half.
        text.contains("collision") && ((4.0 - 0.23 - 0.12) - p_world_m.x).abs() < 0.15
    });
}

#[test]
fn the_fence_is_left_or_cannot_be_held() {
    let way = [[0., 0., 0.], [0., 0., 1.], [0., -3.5, 1.]];
    let breach = |events: &[Event]| {
        matches!(events.last(), Some(Event { kind: EventKind::Geofence { .. }, .. }))
    };
    check(&way, 0.5, |events| {
        breach(events) && events.iter().any(|event| event.text.contains("close to the geofence"))
    });
    check(&way, 6.0, |events| {
        breach(events) && events.last().unwrap().text.contains("cannot stop")
    });
}

#[test]
fn landing_is_no_crash_but_falling_is() {
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
fn time_is_up_even_without_poses_and_a_restart_begins_anew() {
    let mut referee = referee(&arena());
    assert!(fly(&mut referee, &[[0., 0., 0.], [0., 0., 1.], [1., 0., 1.]], 2.0, 1.0).is_empty());
    // The pose is lost first, then the time is over.
    let due = referee.poll_timeout().unwrap();
    referee.handle_timeout(due);
    let lost = referee.poll_event().unwrap();
    assert!(matches!(lost.kind, EventKind::PoseLost { .. }), "{lost:?}");
    let due = referee.poll_timeout().unwrap();
    referee.handle_timeout(due);
    assert_eq!(referee.poll_event().unwrap().kind, EventKind::TimeLimit);
    assert_eq!(referee.poll_timeout(), None);
    referee.restart();
    let way = [[1., 0., 0.], [1., 0., 1.], [8., 0., 1.]];
    let events = fly(&mut referee, &way, 2.0, 40.0);
    let kinds: Vec<_> = events.iter().map(|event| &event.kind).collect();
    assert!(
        matches!(kinds[..], [EventKind::PoseRegained, EventKind::Finished { .. }]),
        "{events:?}"
    );
}

#[test]
fn a_jump_of_the_localization_is_not_flown_through() {
    let mut referee = referee(&arena());
    fly(&mut referee, &[[0., 0., 0.], [0., 1., 1.], [2., 1., 1.]], 2.0, 1.0);
    let newest_s = referee.newest().unwrap().stamp.seconds_since(ServerTime::ZERO);
    // From one side of the post to the other in one packet, and it stays there.
    let mut events = Vec::new();
    for packet in 1..=40 {
        let stamp = ServerTime::ZERO.plus_seconds(newest_s + 0.005 * f64::from(packet));
        let beyond = Pose::new(DVec3::new(6.0, 1.0, 1.0), DQuat::IDENTITY);
        let _ = referee.handle_measurement(stamp, beyond);
        events.extend(std::iter::from_fn(|| referee.poll_event()));
    }
    assert!(events.is_empty(), "{events:?}");
    assert_eq!(referee.newest().unwrap().resets, 1, "the new place is believed in the end");
}

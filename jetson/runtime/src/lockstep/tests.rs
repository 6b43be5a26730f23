//! The companion against what an autopilot and a server tell it, and what it lets a plugin know.

use vizflyt_protocol::geometry::{Intrinsics, Pose, body_from_forward_cam};
use vizflyt_protocol::messages::{FlightPhase, Limits};
use vizflyt_protocol::time::ServerTime;
use vizflyt_sdk::glam::{DQuat, DVec3};
use vizflyt_sdk::{CameraInfo, Observation, ObservationWriter};

use super::*;

fn arena(ground_truth: bool) -> ArenaInfo {
    let mut arena = crate::flight::tests::arena();
    arena.ground_truth = ground_truth;
    arena.cameras.clear();
    let _ = arena.cameras.push(CameraInfo {
        name: bounded("front"),
        intrinsics: Intrinsics::from_horizontal_fov(8, 6, 1.5),
        body_from_cam: body_from_forward_cam(DVec3::ZERO, 0.0),
    });
    arena
}

fn at(ms: u64) -> HostTime {
    HostTime::from_ns(10_000_000_000 + ms * 1_000_000)
}

fn settings() -> FlightSettings {
    FlightSettings { ready_within_s: 60.0, time_limit_s: 0.0, limits: Limits::NONE }
}

/// A companion that has heard of a pose and of a collision, and what its plugin has been told.
fn told(ground_truth: bool) -> (Companion, Vec<ToPlugin>) {
    let mut companion = Companion::new(at(0), &arena(ground_truth), settings());
    let p_world_m = DVec3::new(1.0, 2.0, 3.0);
    let stamp = ServerTime::from_ns(at(5).as_ns());
    let pose = Pose::new(p_world_m, DQuat::IDENTITY);
    companion.handle_pose(at(5), &PoseSample::still(stamp, pose));
    let kind = EventKind::Collision { p_world_m, clearance_m: -0.1 };
    companion.handle_event(at(6), Event { stamp, kind, text: bounded("touched") });
    let messages = std::iter::from_fn(|| companion.poll_plugin()).collect();
    (companion, messages)
}

fn observed<T>(companion: &Companion, look: impl FnOnce(&Observation<'_>) -> T) -> T {
    let cameras = companion.arena.cameras.to_vec();
    let mut blocks = vec![0u64; ObservationWriter::len_for(&cameras).div_ceil(8)];
    let memory = zerocopy::IntoBytes::as_mut_bytes(&mut blocks[..]);
    let mut writer = ObservationWriter::new(memory, 1, &cameras).unwrap();
    companion.write(&mut writer);
    let names = [cameras[0].name.clone()];
    look(&Observation::from_bytes(memory, &names).unwrap())
}

#[test]
fn a_plugin_is_greeted_first_and_learns_of_events_in_order() {
    let (_, messages) = told(true);
    assert!(matches!(&messages[0], ToPlugin::Start(arena) if arena.name == "test"));
    assert_eq!(messages.len(), 2);
}

#[test]
fn what_the_course_withholds_is_nowhere() {
    let place = |messages: &[ToPlugin]| match &messages[1] {
        ToPlugin::Event(Event { kind: EventKind::Collision { p_world_m, .. }, .. }) => *p_world_m,
        other => panic!("{other:?}"),
    };
    let (companion, messages) = told(true);
    assert_eq!(place(&messages), DVec3::new(1.0, 2.0, 3.0));
    observed(&companion, |observation| assert!(observation.vehicle().is_some()));

    let (companion, messages) = told(false);
    assert_eq!(place(&messages), DVec3::ZERO);
    // No attitude of the autopilot's has come, and the pose is not let out.
    observed(&companion, |observation| assert!(observation.vehicle().is_none()));
}

#[test]
fn without_an_autopilot_the_flight_is_given_up_at_its_time() {
    let mut companion = Companion::new(at(0), &arena(true), settings());
    companion.plugin_ready(at(0));
    let mut beats = 0;
    let ended = (0..100_000).map(|tick| at(tick * 5)).find(|&now| {
        companion.handle_timeout(now);
        beats += std::iter::from_fn(|| companion.poll_transmit()).count();
        companion.outcome().is_some()
    });
    // Nothing is in the air after 60 s, by the virtual clock alone.
    let seconds = ended.unwrap().seconds_since(at(0));
    assert!((60.0..60.1).contains(&seconds), "{seconds}");
    assert!((55..70).contains(&beats), "one heartbeat a second: {beats}");
    let reason = &companion.outcome().unwrap().reason;
    assert!(reason.contains("no heartbeat from an autopilot"), "{reason}");
    let phases: Vec<_> = std::iter::from_fn(|| companion.poll_event())
        .filter(|event| matches!(event.kind, EventKind::Phase(_)))
        .collect();
    assert_eq!(
        phases.last().map(|event| &event.kind),
        Some(&EventKind::Phase(FlightPhase::Landed))
    );
}

#[test]
fn the_same_inputs_give_the_same_bytes() {
    let bytes = || {
        let (mut companion, _) = told(true);
        let mut all = Vec::new();
        for tick in 0..2000 {
            companion.handle_timeout(at(10 + 5 * tick));
            while let Some(datagram) = companion.poll_transmit() {
                all.extend_from_slice(&datagram);
            }
        }
        all
    };
    assert!(!bytes().is_empty());
    assert_eq!(bytes(), bytes());
}

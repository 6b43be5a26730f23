//! Tests of the companion with inputs of an autopilot and a server, and of the data given to a plugin.

use vizflyt_protocol::flight_end::{Collision, Obstacle};
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World};
use vizflyt_protocol::messages::{FlightPhase, Limits};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_sdk::glam::{DQuat, DVec3};
use vizflyt_sdk::{ImageStamps, Observation, ObservationWriter};

use super::*;

fn arena(ground_truth: bool) -> ArenaInfo {
    let mut arena = crate::flight::tests::arena();
    arena.ground_truth = ground_truth;
    arena.cameras.clear();
    let intrinsics = Intrinsics::from_horizontal_fov(8, 6, 1.5);
    let _ = arena.cameras.push(CameraInfo::forward("front", intrinsics));
    arena
}

fn at(ms: u64) -> HostTime {
    HostTime::from_ns(10_000_000_000 + ms * 1_000_000)
}

fn companion(ground_truth: bool) -> Companion {
    let settings = FlightSettings {
        ready_within_s: 60.0,
        time_limit_s: 0.0,
        limits: Limits::NONE,
        slip_seed: 7,
        cameras: Vec::new(),
    };
    let mut companion =
        Companion::new(at(0), settings, LinkSettings::default(), ServerClock::same());
    companion.handle_arena(at(0), Box::new(arena(ground_truth)));
    companion
}

/// Returns a companion after a pose and a collision, and the messages to its plugin.
fn after_collision(ground_truth: bool) -> (Companion, Vec<ToPlugin>) {
    let mut companion = companion(ground_truth);
    companion.greet_plugin(at(0));
    let p_world_m = DVec3::new(1.0, 2.0, 3.0);
    let stamp = ServerTime::from_ns(at(5).as_ns());
    let pose = Pose::new(p_world_m, DQuat::IDENTITY);
    companion.handle_pose(at(5), &PoseSample::still(stamp, pose), at(5));
    let (clearance_m, with, speed_mps) = (-0.1, Obstacle::Scene, 1.0);
    let hit = Collision { p_world_m, clearance_m, with, speed_mps };
    companion.handle_event(at(6), &Event::ending(stamp, EventKind::Collision(hit)));
    let messages = std::iter::from_fn(|| companion.poll_plugin()).collect();
    (companion, messages)
}

/// Returns the pose from which an image was rendered.
fn at_image() -> Pose<World, Body> {
    Pose::new(DVec3::new(4.0, 5.0, 6.0), DQuat::IDENTITY)
}

fn observed<T>(companion: &Companion, look: impl FnOnce(&Observation<'_>) -> T) -> T {
    let cameras = companion.arena().unwrap().cameras.to_vec();
    let mut blocks = vec![0u64; ObservationWriter::len_for(&cameras).div_ceil(8)];
    let memory = zerocopy::IntoBytes::as_mut_bytes(&mut blocks[..]);
    let mut writer = ObservationWriter::new(memory, 1, &cameras).unwrap();
    let mut senses = Senses::default();
    companion.update_senses(&mut senses);
    senses.write(&mut writer);
    let k = &cameras[0].intrinsics;
    let header = ImageHeader::new(1, 0, ServerTime::ZERO, k, &Pose::IDENTITY, &at_image());
    writer.image_ready(0, &cameras[0], ImageStamps::default());
    senses.write_pose_at_image(&mut writer, &header);
    let names = [cameras[0].name.clone()];
    look(&Observation::from_bytes(memory, &names).unwrap())
}

#[test]
fn plugin_is_greeted_first_and_receives_events_in_order() {
    let (_, messages) = after_collision(true);
    assert!(matches!(&messages[0], ToPlugin::Start(arena) if arena.name == "test"));
    assert_eq!(messages.len(), 2);
}

#[test]
fn plugin_never_receives_withheld_data() {
    let event = |messages: &[ToPlugin]| match &messages[1] {
        ToPlugin::Event(Event { kind: EventKind::Collision(it), text, .. }) => {
            (it.p_world_m, text.to_string())
        }
        other => panic!("{other:?}"),
    };
    let (companion, messages) = after_collision(true);
    let text = "collision with an obstacle at (1.00, 2.00, 3.00) m, at 1.0 m/s";
    assert_eq!(event(&messages), (DVec3::new(1.0, 2.0, 3.0), text.to_owned()));
    observed(&companion, |observation| {
        assert!(observation.vehicle().is_some());
        assert_eq!(observation.camera("front").unwrap().pose_at_image, Some(at_image()));
    });

    let (companion, messages) = after_collision(false);
    let text = "collision with an obstacle at (withheld) m, at 1.0 m/s";
    assert_eq!(event(&messages), (DVec3::ZERO, text.to_owned()));
    // The autopilot has sent no attitude, and the pose is withheld.
    observed(&companion, |observation| {
        assert!(observation.vehicle().is_none());
        assert_eq!(observation.camera("front").unwrap().pose_at_image, None);
    });
}

#[test]
fn removes_only_points_from_texts() {
    let check = |text: &str, expected: &str| assert_eq!(without_points(text), expected);
    check(
        "landing: hit at (-1.50, 2, 3.0) m, and at (1,2)",
        "landing: hit at (withheld) m, and at (withheld)",
    );
    check("cut off at (1.00, 2.0", "cut off at (withheld");
    check(
        "the plugin ended by itself (exit status 0)",
        "the plugin ended by itself (exit status 0)",
    );
    check(
        "mode change not answered (5 times), (5), ()",
        "mode change not answered (5 times), (5), ()",
    );
    check("", "");
}

#[test]
fn flight_without_an_autopilot_ends_at_its_time_limit() {
    let mut companion = companion(true);
    companion.plugin_ready();
    let mut beats = 0;
    let ended = (0..100_000).map(|tick| at(tick * 5)).find(|&now| {
        companion.handle_timeout(now);
        beats += std::iter::from_fn(|| companion.poll_transmit()).count();
        companion.flight().outcome().is_some()
    });
    // The vehicle is not in the air after 60 s of the virtual clock.
    let seconds = ended.unwrap().seconds_since(at(0));
    assert!((60.0..60.1).contains(&seconds), "{seconds}");
    assert!((4 * 55..4 * 62).contains(&beats), "four heartbeats a second: {beats}");
    let reason = companion.flight().outcome().unwrap().to_string();
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
        let (mut companion, _) = after_collision(true);
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

#[test]
fn no_messages_without_a_plugin_and_the_next_one_receives_the_phase() {
    let (mut companion, _) = after_collision(true);
    companion.plugin_gone();
    companion.note(at(10), "without a plugin");
    assert_eq!(companion.poll_plugin(), None);
    companion.greet_plugin(at(20));
    let messages: Vec<_> = std::iter::from_fn(|| companion.poll_plugin()).collect();
    let [ToPlugin::Start(_), ToPlugin::Event(event)] = &messages[..] else {
        panic!("{messages:?}")
    };
    assert_eq!(event.kind, EventKind::Phase(companion.flight().phase()));
}

#[test]
fn greeting_contains_earlier_camera_changes() {
    let mut companion = companion(true);
    let mut camera = companion.arena().unwrap().cameras[0].clone();
    camera.intrinsics = Intrinsics::from_horizontal_fov(16, 12, 1.5);
    companion.handle_camera(0, &camera);
    // Index without a camera.
    companion.handle_camera(9, &camera);
    companion.greet_plugin(at(0));
    let Some(ToPlugin::Start(arena)) = companion.poll_plugin() else { panic!("no greeting") };
    assert_eq!(arena.cameras[0], camera);
    // Later changes arrive with the images.
    camera.intrinsics = Intrinsics::from_horizontal_fov(8, 6, 1.5);
    companion.handle_camera(0, &camera);
    assert_eq!(companion.arena().unwrap().cameras[0].intrinsics.width_px, 16);
}

//! Both ends in one process; the runtime's tests kill real plugin processes.

use glam::DVec3;
use vizflyt_protocol::geometry::{Intrinsics, body_from_forward_cam};
use vizflyt_protocol::messages::{
    CameraInfo, Event, EventKind, FromPlugin, Setpoint, ToPlugin, bounded,
};
use vizflyt_protocol::time::{HostTime, ServerTime};

use super::*;
use crate::{ImageStamps, Observation, ObservationWriter};

const WAIT: Duration = Duration::from_secs(10);

fn cameras() -> Vec<CameraInfo> {
    vec![CameraInfo {
        name: bounded("front"),
        intrinsics: Intrinsics::from_horizontal_fov(32, 24, 1.5),
        body_from_cam: body_from_forward_cam(DVec3::ZERO, 0.0),
    }]
}

fn publish(runtime: &RuntimeEnd, seq: u64) {
    let cameras = cameras();
    let mut loan = runtime.loan(ObservationWriter::len_for(&cameras)).unwrap();
    let mut writer = ObservationWriter::new(loan.memory(), seq, &cameras).unwrap();
    let planes = writer.planes(0, &cameras[0]).unwrap();
    planes.rgb.fill(seq as u8);
    planes.depth_mm.fill(1000 + seq as u16);
    writer.image_ready(0, &cameras[0], ImageStamps { seq, ..ImageStamps::default() });
    runtime.publish(loan).unwrap();
}

fn ends() -> (RuntimeEnd, PluginEnd) {
    let prefix = unique_service();
    let runtime = RuntimeEnd::create(&prefix, ObservationWriter::len_for(&cameras())).unwrap();
    assert!(!runtime.plugin_attached());
    let plugin = PluginEnd::open(&prefix).unwrap();
    assert!(runtime.plugin_attached());
    (runtime, plugin)
}

fn event(n: usize) -> ToPlugin {
    ToPlugin::Event(Event {
        stamp: ServerTime::from_ns(n as u64),
        kind: EventKind::Note,
        text: bounded("note"),
    })
}

#[test]
fn messages_arrive_both_ways_in_order() {
    let (runtime, plugin) = ends();
    for n in 0..QUEUE_DEPTH {
        runtime.send(&event(n)).unwrap();
    }
    assert!(plugin.wait(WAIT).unwrap());
    for n in 0..QUEUE_DEPTH {
        assert_eq!(plugin.receive().unwrap(), Some(event(n)));
    }
    assert_eq!(plugin.receive().unwrap(), None);

    let answer = FromPlugin::Reply {
        seq: 7,
        entered: HostTime::from_ns(1),
        returned: HostTime::from_ns(2),
        setpoint: Some(Setpoint::Hold),
    };
    plugin.send(&answer).unwrap();
    assert!(runtime.wait(WAIT).unwrap());
    assert_eq!(runtime.receive().unwrap(), Some(answer));
}

#[test]
fn a_plugin_that_does_not_read_is_an_error_not_a_wait() {
    let (runtime, plugin) = ends();
    for n in 0..QUEUE_DEPTH {
        runtime.send(&event(n)).unwrap();
    }
    assert!(matches!(runtime.send(&event(0)), Err(IpcError::QueueFull("plugin"))));
    // Nor do wake-ups that nobody takes ever block, or images nobody looks at.
    for seq in 0..5_000 {
        runtime.heartbeat();
        if seq % 100 == 0 {
            publish(&runtime, seq);
        }
    }
    assert_eq!(plugin.receive().unwrap(), Some(event(0)));
    runtime.send(&event(1)).unwrap();
}

#[test]
fn the_newest_observation_wins_without_a_copy() {
    let (runtime, plugin) = ends();
    assert!(plugin.observation().unwrap().is_none());
    for seq in 1..=9 {
        publish(&runtime, seq);
    }
    let sample = plugin.observation().unwrap().unwrap();
    let names = [bounded("front")];
    let observation = Observation::from_bytes(sample.bytes(), &names).unwrap();
    assert_eq!(observation.seq(), 9);
    let front = observation.camera("front").unwrap();
    assert_eq!((front.rgb[0], front.depth_m(31, 23)), (9, Some(1.009)));
    assert_eq!((front.depth_m(32, 0), front.rgb_at(0, 24)), (None, None));
    // The view lies in the shared memory itself, and stays while newer ones come.
    assert!(sample.bytes().as_ptr_range().contains(&front.rgb.as_ptr()));
    for seq in 10..=30 {
        publish(&runtime, seq);
    }
    assert_eq!(front.rgb[0], 9);
    drop(sample);
    let sample = plugin.observation().unwrap().unwrap();
    assert_eq!(Observation::from_bytes(sample.bytes(), &names).unwrap().seq(), 30);
    assert!(plugin.observation().unwrap().is_none());
}

#[test]
fn a_second_plugin_can_follow_the_first() {
    let prefix = unique_service();
    let runtime = RuntimeEnd::create(&prefix, 4096).unwrap();
    for _ in 0..5 {
        let plugin = PluginEnd::open(&prefix).unwrap();
        runtime.send(&ToPlugin::Stop).unwrap();
        assert_eq!(plugin.receive().unwrap(), Some(ToPlugin::Stop));
        drop(plugin);
        assert!(!runtime.plugin_attached());
    }
}

#[test]
fn reports_a_missing_runtime() {
    let error = PluginEnd::open("vizflyt/nobody").unwrap_err();
    assert_eq!(
        error.to_string(),
        "no runtime offers vizflyt/nobody; start the plugin with `vizflyt fly`"
    );
}

#[test]
fn a_prefix_in_use_is_an_error() {
    let prefix = unique_service();
    let _first = RuntimeEnd::create(&prefix, 4096).unwrap();
    assert!(matches!(RuntimeEnd::create(&prefix, 4096), Err(IpcError::Transport { .. })));
}

#[test]
fn the_runtimes_end_is_shared_between_threads() {
    fn check<T: Send>() {}
    check::<std::sync::Arc<RuntimeEnd>>();
    check::<LoanedObservation>();
}

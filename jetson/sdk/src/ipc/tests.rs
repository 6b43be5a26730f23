//! Tests of both ends in one process. The tests of the runtime kill real plugin processes.

use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_protocol::messages::{
    CameraInfo, Event, EventKind, FromPlugin, Setpoint, ToPlugin, bounded,
};
use vizflyt_protocol::time::{HostTime, ServerTime};

use super::*;
use std::time::Duration;

use crate::{ImageStamps, Observation, ObservationWriter};

const WAIT: Duration = Duration::from_secs(10);
/// Messages that a plugin may leave unread during one `on_image`.
const MESSAGES: usize = 128;

fn cameras() -> Vec<CameraInfo> {
    vec![CameraInfo::forward("front", Intrinsics::from_horizontal_fov(32, 24, 1.5))]
}

fn publish(runtime: &RuntimeEnd, seq: u64) {
    publish_one(runtime, seq).unwrap();
}

fn publish_one(runtime: &RuntimeEnd, seq: u64) -> Result<(), IpcError> {
    let cameras = cameras();
    let mut loan = runtime.loan(ObservationWriter::len_for(&cameras))?;
    let mut writer = ObservationWriter::new(loan.memory(), seq, &cameras).unwrap();
    let planes = writer.planes(0, &cameras[0]).unwrap();
    planes.rgb.fill(seq as u8);
    planes.depth_mm.fill(1000 + seq as u16);
    writer.image_ready(0, &cameras[0], ImageStamps { seq, ..ImageStamps::default() });
    runtime.publish(loan)
}

fn ends() -> (RuntimeEnd, PluginEnd) {
    let runtime = RuntimeEnd::new(ObservationWriter::len_for(&cameras()));
    assert!(!runtime.plugin_attached());
    let plugin = attach(&runtime);
    assert!(runtime.plugin_attached());
    (runtime, plugin)
}

fn attach(runtime: &RuntimeEnd) -> PluginEnd {
    PluginEnd::attach(runtime.connect().unwrap()).unwrap()
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
    for n in 0..MESSAGES {
        runtime.send(&event(n)).unwrap();
    }
    assert!(plugin.wait(WAIT).unwrap());
    for n in 0..MESSAGES {
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
fn sending_to_a_plugin_that_does_not_read_fails_without_waiting() {
    let (runtime, plugin) = ends();
    let full = (0..100_000).find_map(|n| runtime.send(&event(n)).err().map(|error| (n, error)));
    let (sent, error) = full.expect("the socket has an end");
    assert!(sent >= MESSAGES && matches!(error, IpcError::QueueFull("plugin")), "{sent}: {error}");
    // Publishing does not block either if the plugin takes no bell and no image, but the descriptor of new memory
    // cannot be sent.
    assert!(publish_one(&runtime, 0).is_err());
    for n in 0..sent {
        assert_eq!(plugin.receive().unwrap(), Some(event(n)));
    }
    for seq in 1..5_000 {
        publish(&runtime, seq);
    }
    runtime.send(&event(1)).unwrap();
    assert_eq!(plugin.receive().unwrap(), Some(event(1)));
    assert!(plugin.observation().unwrap().is_some());
}

#[test]
fn plugin_waits_while_the_socket_is_full() {
    let (runtime, plugin) = ends();
    let failed = |n: usize| FromPlugin::Failed { reason: bounded(&n.to_string()) };
    std::thread::scope(|scope| {
        scope.spawn(|| (0..5_000).for_each(|n| plugin.send(&failed(n)).unwrap()));
        for n in 0..5_000 {
            let next = std::iter::repeat_with(|| {
                assert!(runtime.wait(WAIT).unwrap());
                runtime.receive().unwrap()
            });
            assert_eq!(next.flatten().next(), Some(failed(n)));
        }
    });
}

#[test]
fn sent_messages_arrive_after_the_sender_has_ended() {
    let (runtime, plugin) = ends();
    let last = FromPlugin::Failed { reason: bounded("last words") };
    plugin.send(&last).unwrap();
    drop(plugin);
    assert_eq!(runtime.receive().unwrap(), Some(last));
    assert_eq!(runtime.receive().unwrap(), None);
    assert!(!runtime.plugin_attached());

    let (runtime, plugin) = ends();
    runtime.send(&ToPlugin::Stop).unwrap();
    drop(runtime);
    assert!(plugin.wait(WAIT).unwrap());
    assert_eq!(plugin.receive().unwrap(), Some(ToPlugin::Stop));
    assert!(plugin.wait(WAIT).unwrap(), "the end of the runtime must wake the plugin");
    assert!(matches!(plugin.receive(), Err(IpcError::Gone("runtime"))));
    assert!(matches!(
        plugin.send(&FromPlugin::Ready { name: bounded("x") }),
        Err(IpcError::Gone(_))
    ));
}

#[test]
fn invalid_messages_are_errors_and_the_next_one_is_read() {
    let (runtime, plugin) = ends();
    for bytes in [&[][..], &[255; 9], &[7; vizflyt_protocol::packet::framing::MAX_FRAMED]] {
        plugin.send_bytes(bytes).unwrap();
        assert!(matches!(runtime.receive(), Err(IpcError::Message(_))), "{} bytes", bytes.len());
    }
    let ready = FromPlugin::Ready { name: bounded("me") };
    plugin.send(&ready).unwrap();
    assert_eq!(runtime.receive().unwrap(), Some(ready));
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
    // The view lies in the shared memory itself, and does not change when newer observations arrive.
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
fn plugin_can_keep_three_observations_and_no_more() {
    let (runtime, plugin) = ends();
    let mut kept = Vec::new();
    for seq in 1..=BORROWED_OBSERVATIONS as u64 {
        publish(&runtime, seq);
        kept.push(plugin.observation().unwrap().unwrap());
    }
    publish(&runtime, 9);
    assert!(matches!(plugin.observation(), Err(IpcError::NoSlot(BORROWED_OBSERVATIONS))));
    // The runtime can still write two, but not a third.
    let (_one, _two) = (runtime.loan(100).unwrap(), runtime.loan(100).unwrap());
    assert!(matches!(runtime.loan(100), Err(IpcError::NoSlot(_))));
    kept.remove(0);
    let names = [bounded("front")];
    let newest = plugin.observation().unwrap().unwrap();
    assert_eq!(Observation::from_bytes(newest.bytes(), &names).unwrap().seq(), 9);
    for (seq, sample) in [2, 3].into_iter().zip(&kept) {
        assert_eq!(Observation::from_bytes(sample.bytes(), &names).unwrap().seq(), seq);
    }
}

#[test]
fn memory_grows_with_the_images() {
    let (runtime, plugin) = ends();
    for len in [100, 5_000, 1 << 20, 64, 3 << 20] {
        let mut kept = Vec::new();
        for fill in 1..=BORROWED_OBSERVATIONS as u8 {
            let mut loan = runtime.loan(len).unwrap();
            assert!(loan.bytes().iter().all(|&byte| byte == 0) && loan.bytes().len() == len);
            loan.memory().fill(fill);
            runtime.publish(loan).unwrap();
            let sample = plugin.observation().unwrap().unwrap();
            assert!(sample.bytes().as_ptr().addr().is_multiple_of(64));
            kept.push((fill, sample));
        }
        for (fill, sample) in kept {
            assert!(sample.bytes().len() == len && sample.bytes().iter().all(|&byte| byte == fill));
        }
    }
}

#[test]
fn several_plugins_can_attach_one_after_another() {
    let runtime = RuntimeEnd::new(4096);
    for seq in 1..=5 {
        let plugin = attach(&runtime);
        runtime.send(&ToPlugin::Stop).unwrap();
        assert_eq!(plugin.receive().unwrap(), Some(ToPlugin::Stop));
        publish(&runtime, seq);
        let sample = plugin.observation().unwrap().unwrap();
        // Slots that a plugin did not return are reclaimed after its end.
        std::mem::forget(sample);
        publish(&runtime, seq);
        drop(plugin);
        assert!(!runtime.plugin_attached());
        runtime.clean_up();
    }
    // Without a plugin, observations are dropped.
    (1..100).for_each(|seq| publish(&runtime, seq));
}

#[test]
fn plugin_started_by_hand_finds_the_offer() {
    let runtime = RuntimeEnd::new(4096);
    let offer = runtime.offer().unwrap();
    assert!(offers().contains(&offer.service()));
    assert!(!runtime.plugin_attached());
    let service = offer.service();
    let plugin = std::thread::spawn(move || PluginEnd::open(&service).unwrap());
    while !runtime.plugin_attached() {
        std::thread::yield_now();
    }
    let plugin = plugin.join().unwrap();
    runtime.send(&ToPlugin::Stop).unwrap();
    assert_eq!(plugin.receive().unwrap(), Some(ToPlugin::Stop));
    let service = offer.service();
    drop(offer);
    assert!(!offers().contains(&service));
}

#[test]
fn reports_that_there_is_no_runtime() {
    for nobody in ["/nowhere/at/all", "fd:987", "fd:-1", "fd:x", ""] {
        let error = PluginEnd::open(nobody).unwrap_err().to_string();
        let expected = format!("no runtime offers {nobody}; start the plugin with `vizflyt fly`");
        assert_eq!(error, expected);
    }
}

#[test]
fn runtime_end_can_be_shared_between_threads() {
    fn check<T: Send>() {}
    check::<std::sync::Arc<RuntimeEnd>>();
    check::<LoanedObservation>();
}

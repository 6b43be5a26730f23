//! Checks of all drivers on a virtual clock: poses that are not measurements, and a second sender.

use std::net::SocketAddr;

use glam::DVec3;
use vizflyt_arena::pose::{PoseChange, PoseFilter, Rejected};
use vizflyt_protocol::time::ServerTime;

use super::source::Measurement;
use super::udp::PoseStream;

const FIRST: &str = "10.0.0.5:1511";
const SECOND: &str = "10.0.0.5:1512";

fn at(index: u32) -> ServerTime {
    ServerTime::from_ns(10_000_000_000 + u64::from(index) * 20_000_000)
}

/// Returns a position in a hover with noise.
fn hover(index: u32) -> DVec3 {
    DVec3::new(1.0, 2.0, 1.0 + 1e-4 * f64::from(index % 7))
}

/// Flies on the poses of `send` (time, index, position), then sends the origin or the last pose instead. Panics if
/// one of these is used, or if the poses are not lost in time. Returns the reason of the loss.
pub(super) fn reason(
    origin: bool,
    mut send: impl FnMut(ServerTime, u32, DVec3) -> Option<Measurement>,
) -> Option<Rejected> {
    let mut filter = PoseFilter::default();
    filter.set_in_flight(true);
    for index in 0..100 {
        let measurement = send(at(index), index, hover(index)).expect("a pose");
        filter.handle_pose(&measurement.with_covariance()).unwrap();
    }
    let newest = *filter.newest().unwrap();
    let mut reason = None;
    for index in 100..300 {
        let p_m = if origin { DVec3::ZERO } else { hover(99) };
        if let Some(measurement) = send(at(index), index, p_m) {
            let _ = filter.handle_pose(&measurement.with_covariance());
        }
        filter.handle_timeout(at(index));
        assert_eq!(filter.newest(), Some(&newest), "pose {index} was used");
        match filter.poll_change() {
            Some(PoseChange::Lost(_, why)) => {
                assert!(index <= 109, "lost only after {index}");
                reason = Some(why);
            }
            Some(change) => panic!("{change:?}"),
            None => {}
        }
    }
    for index in 300..310 {
        let measurement = send(at(index), index, hover(index)).expect("a pose");
        let _ = filter.handle_pose(&measurement.with_covariance());
    }
    assert_eq!(filter.poll_change(), Some(PoseChange::Regained));
    reason.expect("the poses are lost")
}

/// Like [`reason`], for the datagrams of `packet` (index, position).
pub(super) fn reason_of(
    origin: bool,
    stream: &mut impl PoseStream,
    packet: impl Fn(u32, DVec3) -> Vec<u8>,
) -> Option<Rejected> {
    reason(origin, |now, index, p_m| {
        stream.handle_packet(now, &packet(index, p_m)).first().copied()
    })
}

/// Sends poses of one vehicle from two addresses, then only from the second. Panics unless the poses are used only
/// while one address sends, with a message about both.
pub(super) fn check_second_sender(
    stream: &mut impl PoseStream,
    packet: impl Fn(u32, DVec3) -> Vec<u8>,
) {
    let [first, second]: [SocketAddr; 2] = [FIRST, SECOND].map(|text| text.parse().unwrap());
    let mut send = |from, index: u32| {
        let used =
            !stream.handle_packet_from(at(index), from, &packet(index, hover(index))).is_empty();
        (used, std::iter::from_fn(|| stream.next_warning()).collect::<Vec<_>>())
    };
    for index in 0..50 {
        assert_eq!(send(first, index), (true, vec![]));
    }
    let mut warnings = Vec::new();
    for index in 50..150 {
        for from in [second, first] {
            let (used, warned) = send(from, index);
            assert!(!used, "{from} at {index}");
            warnings.extend(warned);
        }
    }
    let [warning] = &warnings[..] else { panic!("{warnings:?}") };
    assert!(warning.contains(FIRST) && warning.contains(SECOND), "{warning}");
    // The first one is stopped; after its silence, the second one takes over.
    let used_from = (150..250).find(|&index| send(second, index).0).expect("the second takes over");
    assert!((174..=177).contains(&used_from), "{used_from}");
    assert!(send(second, used_from + 1).0);
}

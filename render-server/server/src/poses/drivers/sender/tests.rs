use super::*;

fn at(ms: u64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000 + ms * 1_000_000)
}

fn address(port: u16) -> SocketAddr {
    ([10, 0, 0, 7], port).into()
}

#[test]
fn two_senders_are_reported_once_and_neither_is_used() {
    let mut sender = Sender::default();
    assert_eq!(sender.handle_packet(address(1), at(0)), Heard::Pinned);
    let mut reports = Vec::new();
    for ms in (10..4000).step_by(10) {
        assert_eq!(sender.handle_packet(address(2), at(ms)), Heard::Other);
        match sender.handle_packet(address(1), at(ms + 5)) {
            Heard::Conflict(other) => reports.extend(other.map(|other| (ms, other))),
            heard => panic!("{heard:?}"),
        }
    }
    assert_eq!(reports, [(10, address(2))]);
    assert!(sender.may_be(address(1), at(4000)) && !sender.may_be(address(2), at(4000)));
    // The second one stops.
    assert_eq!(sender.handle_packet(address(1), at(4200)), Heard::Conflict(None));
    assert_eq!(sender.handle_packet(address(1), at(4300)), Heard::Pinned);
}

#[test]
fn restarted_sender_takes_over_after_the_former_is_silent() {
    let mut sender = Sender::default();
    sender.handle_packet(address(1), at(0));
    for ms in [100, 300, 500] {
        assert_eq!(sender.handle_packet(address(2), at(ms)), Heard::Other);
    }
    assert_eq!(sender.handle_packet(address(2), at(510)), Heard::TookOver(Some(address(1))));
    assert_eq!(sender.handle_packet(address(2), at(520)), Heard::Pinned);
}

#[test]
fn a_new_port_for_each_packet_is_reported_once() {
    let mut sender = Sender::default();
    let heard: Vec<_> =
        (0..400).map(|i| sender.handle_packet(address(i), at(10 * u64::from(i)))).collect();
    let reports = heard.iter().filter(|heard| matches!(heard, Heard::TookOver(Some(_)))).count();
    assert_eq!(reports, 1);
}

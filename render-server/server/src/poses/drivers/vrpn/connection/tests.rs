use super::super::tests::{RECORDED, STANDS, beginning, report, stream};
use super::*;
use std::net::{TcpListener, TcpStream};

/// Waits at most 30 s for a pose of a source.
fn next_pose(source: &mut VrpnPoses) -> Measurement {
    for _ in 0..300 {
        if let Some(pose) = source.receive(Duration::from_millis(100)).first() {
            return *pose;
        }
    }
    panic!("no pose came");
}

/// Waits at most 30 s for the next warning of a source.
fn next_warning(source: &mut VrpnPoses) -> String {
    for _ in 0..300 {
        source.receive(Duration::from_millis(100));
        if let Some(warning) = source.next_warning() {
            return warning;
        }
    }
    panic!("no warning came");
}

/// Accepts a client, and reads its first bytes.
fn accept(listener: &TcpListener) -> TcpStream {
    let (mut client, _) = listener.accept().unwrap();
    let mut cookie = [0; 24];
    client.read_exact(&mut cookie).unwrap();
    assert_eq!(&cookie, COOKIE);
    client
}

/// Receives until the server has announced its button.
fn settle(source: &mut VrpnPoses) {
    for _ in 0..300 {
        source.receive(Duration::from_millis(100));
        if source.stream.described().as_deref() == Some("'Button0'") {
            return;
        }
    }
    panic!("no connection came");
}

#[test]
fn connects_and_reconnects_to_a_server() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let server = listener.local_addr().unwrap();
    let served = std::thread::spawn(move || {
        let mut first = accept(&listener);
        first.write_all(RECORDED).unwrap();
        drop(first);
        let mut second = accept(&listener);
        for part in beginning(&[("wasp", 1)]).chunks(7) {
            second.write_all(part).unwrap();
        }
        second.write_all(&report(5_000_000, 1, 0, STANDS)).unwrap();
        second
    });
    let mut source = VrpnPoses::new(server, stream(""));
    assert_eq!(next_pose(&mut source).vehicle, 0);
    let lost =
        std::iter::repeat_with(|| next_warning(&mut source)).find(|text| text.contains("lost"));
    assert_eq!(
        lost.unwrap(),
        format!(
            "vrpn: the connection to {server} was lost: it has closed the connection; is the motion capture \
             live, and its network there?"
        )
    );
    assert_eq!(source.counters(0).poses, 11, "what had come was read to its end");
    // The first report after the reconnection gives a pose.
    let back = next_pose(&mut source);
    assert_eq!((back.vehicle, back.stamp), (1, back.arrival));
    let second = served.join().unwrap();
    assert_eq!(source.next_warning(), None);
    // Simulates that it came a second ago.
    source.notice_silence(back.arrival.plus_seconds(1.0));
    assert_eq!(
        source.next_warning().unwrap(),
        format!(
            "vrpn: no sample for 1000 ms from {server}; is the motion capture live, and its network there?"
        )
    );
    source.notice_silence(back.arrival.plus_seconds(2.0));
    assert_eq!(source.next_warning(), None, "reported once");
    drop(second);
}

#[test]
fn reports_a_missing_server_and_one_without_vrpn() {
    let listen = || {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let server = listener.local_addr().unwrap();
        (listener, server, VrpnPoses::new(server, stream("")))
    };
    let later = || clock::now().plus_seconds(6.0);
    // No server listens.
    let (listener, server, mut source) = listen();
    drop(listener);
    for _ in 0..300 {
        if source.fault.is_some() {
            break;
        }
        source.receive(Duration::from_millis(100));
    }
    source.notice_silence(later());
    let warning = source.next_warning().unwrap();
    assert!(warning.starts_with(&format!("vrpn: cannot connect to {server} for ")), "{warning}");
    assert!(warning.contains("refused"), "{warning}");

    // The server accepts, and sends nothing.
    let (listener, server, mut source) = listen();
    let served = std::thread::spawn(move || accept(&listener));
    for _ in 0..300 {
        if source.is_connected() {
            break;
        }
        source.receive(Duration::from_millis(100));
    }
    source.notice_silence(later());
    let warning = source.next_warning().unwrap();
    assert!(warning.starts_with(&format!("vrpn: {server} has not answered for ")), "{warning}");
    drop(served.join().unwrap());

    // The server replies, but has no tracker.
    let (listener, server, mut source) = listen();
    let served = std::thread::spawn(move || {
        let mut client = accept(&listener);
        client.write_all(&beginning(&[("VRPN Control", 0), ("Button0", 1)])).unwrap();
        client
    });
    settle(&mut source);
    source.notice_silence(later());
    let warning = source.next_warning().unwrap();
    assert!(warning.starts_with(&format!("vrpn: {server} has sent no pose for ")), "{warning}");
    assert!(warning.contains("it has 'Button0'"), "{warning}");
    drop(served.join().unwrap());

    // The server speaks another protocol.
    let (listener, _, mut source) = listen();
    let served = std::thread::spawn(move || {
        accept(&listener).write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n").unwrap();
    });
    assert_eq!(
        next_warning(&mut source),
        "vrpn: it does not begin as VRPN does; is that address a VRPN server's? (further bad packets are only \
         counted)"
    );
    served.join().unwrap();
}

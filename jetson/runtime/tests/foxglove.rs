//! A viewer as Foxglove is one: connects by WebSocket, receives the channels, subscribes to one,
//! gets its messages. Written against the protocol (foxglove.sdk.v1), not against the library.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use serde_json::{Value, json};
use vizflyt_runtime::log::{Channel, FlightLog, Live, LogSettings};
use vizflyt_sdk::host_now;

struct Viewer(TcpStream);

impl Viewer {
    fn connect(address: std::net::SocketAddr) -> Self {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
        write!(
            stream,
            "GET / HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
             Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        .unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            head.push(byte[0]);
        }
        let head = String::from_utf8(head).unwrap();
        assert!(head.starts_with("HTTP/1.1 101"), "{head}");
        Self(stream)
    }

    /// Reads a frame (RFC 6455, 5.2): whether it is text, and what is in it.
    fn read(&mut self) -> (bool, Vec<u8>) {
        let mut head = [0; 2];
        self.0.read_exact(&mut head).unwrap();
        let len = match head[1] {
            126 => {
                let mut len = [0; 2];
                self.0.read_exact(&mut len).unwrap();
                u64::from(u16::from_be_bytes(len))
            }
            127 => {
                let mut len = [0; 8];
                self.0.read_exact(&mut len).unwrap();
                u64::from_be_bytes(len)
            }
            len => u64::from(len),
        };
        let mut body = vec![0; len as usize];
        self.0.read_exact(&mut body).unwrap();
        (head[0] & 15 == 1, body)
    }

    /// Sends a short text.
    fn send(&mut self, message: &Value) {
        let text = message.to_string();
        let len = u8::try_from(text.len()).ok().filter(|len| *len < 126).unwrap();
        // A client masks; by zeros, nothing changes.
        self.0.write_all(&[0x81, 0x80 | len, 0, 0, 0, 0]).unwrap();
        self.0.write_all(text.as_bytes()).unwrap();
    }
}

#[test]
fn a_viewer_sees_the_logs_channels_and_their_messages() {
    let tokio = tokio::runtime::Runtime::new().unwrap();
    let live = tokio.block_on(Live::start("127.0.0.1:0".parse().unwrap())).unwrap();
    let address = live.address();
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), Some(live));
    let mut viewer = Viewer::connect(address);
    let mut channels = Vec::new();
    while !channels.iter().any(|channel: &Value| channel["topic"] == "/pose") {
        let (is_text, body) = viewer.read();
        if is_text && let Ok(message) = serde_json::from_slice::<Value>(&body) {
            channels.extend(message["channels"].as_array().into_iter().flatten().cloned());
        }
    }
    let find = |topic: &str| channels.iter().find(|channel| channel["topic"] == topic).unwrap();
    assert_eq!(find("/pose")["schemaName"], "foxglove.PoseInFrame");
    let asked = find("/setpoint/asked");
    assert_eq!(asked["encoding"], "json");
    viewer.send(&json!({"op": "subscribe",
        "subscriptions": [{"id": 7, "channelId": asked["id"]}]}));
    // Whatever is logged before the subscription counts is not sent: go on until one comes.
    viewer.0.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let mut first = [0; 1];
    let body = loop {
        log.write(Channel::Requested, host_now(), &json!({"seq": 12_345}));
        if viewer.0.peek(&mut first).is_ok() {
            viewer.0.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
            let (is_text, body) = viewer.read();
            if !is_text {
                break body;
            }
            viewer.0.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        }
    };
    let text = String::from_utf8_lossy(&body);
    assert!(text.ends_with(r#"{"seq":12345}"#), "{text}");
    drop(log);
}

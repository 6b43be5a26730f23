//! Test with a viewer like Foxglove: it connects by WebSocket, receives the channels, subscribes to one, and
//! receives its messages. Uses the protocol (foxglove.sdk.v1) instead of the library.

use std::time::Duration;

use serde_json::{Value, json};
use vizflyt_fixtures::{TEXT, WebSocket};
use vizflyt_runtime::log::{Channel, FlightLog, Live, LogSettings};
use vizflyt_sdk::host_now;

#[test]
fn viewer_receives_channels_and_messages_of_the_log() {
    let tokio = tokio::runtime::Runtime::new().unwrap();
    let live = tokio.block_on(Live::start("127.0.0.1:0".parse().unwrap())).unwrap();
    let address = live.address();
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), Some(live));
    let protocol = "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n";
    let mut viewer = WebSocket::open(address, "/", protocol).ok().unwrap();
    let mut channels = Vec::new();
    while !channels.iter().any(|channel: &Value| channel["topic"] == "/pose") {
        let (opcode, body) = viewer.receive();
        if opcode == TEXT
            && let Ok(message) = serde_json::from_slice::<Value>(&body)
        {
            channels.extend(message["channels"].as_array().into_iter().flatten().cloned());
        }
    }
    let find = |topic: &str| channels.iter().find(|channel| channel["topic"] == topic).unwrap();
    assert_eq!(find("/pose")["schemaName"], "foxglove.PoseInFrame");
    let asked = find("/setpoint/asked");
    assert_eq!(asked["encoding"], "json");
    let subscription = json!({"id": 7, "channelId": asked["id"]});
    viewer.send(&json!({"op": "subscribe", "subscriptions": [subscription]}).to_string());
    // Messages logged before the subscription takes effect are not sent, so repeat until one arrives.
    viewer.stream().set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let mut first = [0; 1];
    let body = loop {
        log.write(Channel::Requested, host_now(), &json!({"seq": 12_345}));
        if viewer.stream().peek(&mut first).is_ok() {
            viewer.stream().set_read_timeout(Some(Duration::from_mins(1))).unwrap();
            let (opcode, body) = viewer.receive();
            if opcode != TEXT {
                break body;
            }
            viewer.stream().set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        }
    };
    let text = String::from_utf8_lossy(&body);
    assert!(text.ends_with(r#"{"seq":12345}"#), "{text}");
    drop(log);
}

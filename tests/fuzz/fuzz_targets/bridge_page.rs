//! Page of the bridge: requests with any bytes in any portions, including forms. No panic; bounded memory; settings
//! change only with the key, and are never rendered as markup.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_bridge::http::{Progress, Request};
use vizflyt_bridge::page::{self, form::Form};
use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::time::HostTime;

const KEY: &str = "abcd-efgh-2345-6789";

fuzz_target!(|requests: Vec<Vec<&[u8]>>| {
    let mut settings = Settings::default();
    settings.set("page.key", KEY).unwrap();
    let mut bridge = Bridge::new(HostTime::ZERO, settings, Chip::default());
    for (second, portions) in requests.into_iter().enumerate() {
        let now = HostTime::from_ns(3_000_000_000 * second as u64);
        let mut request = Request::new();
        let mut progress = Progress::More;
        for bytes in &portions {
            progress = request.push(bytes);
            match progress {
                Progress::More => {}
                Progress::Whole => break,
                Progress::Firmware(from) => {
                    assert!(from <= bytes.len());
                    break;
                }
            }
        }
        if progress != Progress::Whole {
            continue;
        }
        let before = bridge.settings().clone();
        let done = page::act(&mut bridge, now, &request);
        let has_key = Form::parse(request.body()).is_some_and(|form| form.key == KEY);
        assert!(has_key || *bridge.settings() == before, "changed without the key");
        let mut part = page::Response::new();
        for place in 0..10 {
            if !page::respond(&bridge, now, &request, done, place, &mut part) {
                break;
            }
            assert!(place > 0 || part.starts_with("HTTP/1.0 "));
            assert!(!part.contains("<script"), "a setting is text");
        }
        while bridge.poll_event().is_some() {}
    }
});

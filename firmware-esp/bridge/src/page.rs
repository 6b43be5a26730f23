//! Web page of the bridge: state, counters (also as JSON) and settings. Changes of settings need the key, see [`form`].
//! A firmware upload needs a valid signature.

pub mod form;

use core::fmt::{self, Write as _};

use form::Form;
use heapless::String;
use vizflyt_protocol::time::HostTime;

use crate::access::Status;
use crate::bridge::{Bridge, LandingStage, Peer};
use crate::http::Request;
use crate::stats::REPORT;

/// Maximum length of a part of a response [bytes].
pub const RESPONSE: usize = 2048;
/// Part of a response.
pub type Response = String<RESPONSE>;

/// Head of every page. The policy forbids foreign content, framing and foreign form targets.
const HTML: &str = "HTTP/1.0 200 OK\r\nContent-Type: text/html; charset=utf-8\r\n\
    Cache-Control: no-store\r\nConnection: close\r\nX-Frame-Options: DENY\r\n\
    Content-Security-Policy: default-src 'none'; form-action 'self'\r\n\r\n<!doctype html>";
/// Rest of the head of every other answer, after its first line.
const TEXT: &str = "\r\nContent-Type: text/plain; charset=utf-8\r\nConnection: close\r\n\r\n";

/// Executes the change that a request contains, once. Returns its status, or `None` if the request is not a change.
#[inline(never)] // Why: as `respond`.
pub fn act(bridge: &mut Bridge, now: HostTime, request: &Request) -> Option<Status> {
    if request.is_too_long() || !request.is(b"POST /settings ") {
        return None;
    }
    let form = Form::parse(request.body()).filter(|_| !request.is_foreign());
    Some(form.map_or(Status::Malformed, |form| bridge.change_by_form(now, &form)))
}

/// Writes one part of the answer into `out`. `done` is the result of [`act`]. Returns false after the last part.
#[inline(never)] // Why: inlined, its frame would stay on the caller's small stack.
pub fn respond(
    bridge: &Bridge,
    now: HostTime,
    request: &Request,
    done: Option<Status>,
    part: usize,
    out: &mut Response,
) -> bool {
    out.clear();
    let written = match done {
        None if request.is(b"GET /settings ") && !request.is_too_long() => {
            form::write_part(bridge, part, out)
        }
        _ if part > 0 => Ok(false),
        Some(status) => answer_change(status, out).map(|()| true),
        None => answer(bridge, now, request, out).map(|()| true),
    };
    written.unwrap_or_else(|fmt::Error| {
        // More clients than fit: return an error instead of half a page.
        out.clear();
        let _ = writeln!(out, "HTTP/1.0 500 Internal Server Error{TEXT}too long");
        true
    })
}

fn answer(bridge: &Bridge, now: HostTime, request: &Request, out: &mut Response) -> fmt::Result {
    if request.is_too_long() {
        writeln!(out, "HTTP/1.0 413 Content Too Large{TEXT}too long")
    } else if request.is(b"GET / ") {
        page(bridge, now, out)
    } else if request.is(b"GET /stats.json ") {
        json(counters(bridge, now), out)
    } else if request.is(b"GET /status.json") {
        json(station_counters(bridge).into_iter(), out)
    } else {
        writeln!(out, "HTTP/1.0 404 Not Found{TEXT}there is /, /settings and /stats.json")
    }
}

fn answer_change(status: Status, out: &mut Response) -> fmt::Result {
    let line = form::status_line(status);
    writeln!(out, "HTTP/1.0 {line}{TEXT}{}; go back to see the settings", status.message())
}

/// Writes the answer to a firmware upload into `out`.
pub fn respond_firmware(taken: Result<(), &str>, out: &mut Response) {
    out.clear();
    // The longest reason is a sentence, so it fits.
    let _ = match taken {
        Ok(()) => out.write_str(
            "HTTP/1.0 200 OK\r\nConnection: close\r\n\r\nverified; it starts now, on trial\n",
        ),
        Err(why) => {
            write!(out, "HTTP/1.0 409 Conflict\r\nConnection: close\r\n\r\n{why}\n")
        }
    };
}

fn counters(bridge: &Bridge, now: HostTime) -> impl Iterator<Item = (&'static str, u32)> {
    REPORT.iter().copied().zip(bridge.stats().report(bridge.uptime_s(now)))
}

/// Counters in the format of QGroundControl's bridge page; `v` is the vehicle, `g` the ground.
fn station_counters(bridge: &Bridge) -> [(&'static str, u32); 6] {
    let stats = bridge.stats();
    [
        ("vpackets", stats.uart.cut.packets),
        ("vsent", stats.uart.packets_out),
        ("vlost", stats.uart.lost),
        ("gpackets", stats.net.cut.packets),
        ("gsent", stats.net.packets_out),
        ("glost", stats.net.lost),
    ]
}

fn page(bridge: &Bridge, now: HostTime, out: &mut Response) -> fmt::Result {
    out.write_str(HTML)?;
    out.write_str("<meta http-equiv=refresh content=2><title>bridge</title>")?;
    // The name contains only letters, digits and hyphens, so nothing needs escaping.
    write!(out, "<h1>{}</h1><a href=/settings>settings</a><pre>", bridge.settings().hostname)?;
    if bridge.is_transparent() {
        writeln!(out, "transparent: bytes pass unparsed; no priorities, no LAND")?;
    }
    if let Some(cause) = bridge.stats().restart_cause.message() {
        writeln!(out, "{cause}")?;
    }
    match bridge.autopilot() {
        Some((system, _)) if bridge.is_armed() => writeln!(out, "vehicle {system}, armed")?,
        Some((system, _)) => writeln!(out, "vehicle {system}, disarmed")?,
        None => writeln!(out, "no vehicle")?,
    }
    match bridge.landing() {
        None => {}
        Some(LandingStage::Asked) if bridge.is_unanswered(now) => {
            writeln!(out, "the companion is silent; LAND is not acknowledged")?;
        }
        Some(LandingStage::Asked) => writeln!(out, "the companion is silent; asks for LAND")?,
        Some(_) => writeln!(out, "the companion is silent; the vehicle lands")?,
    }
    if bridge.settings().key.is_none() {
        writeln!(out, "no key yet: vizflyt bridge configure --claim")?;
    }
    for (peer, sent, slow) in bridge.clients() {
        match peer {
            Peer::Udp(address) => write!(out, "udp {address}")?,
            Peer::Tcp(slot) => write!(out, "tcp {slot}")?,
        }
        writeln!(out, ": {sent} sent, {slow} dropped")?;
    }
    for (name, value) in counters(bridge, now) {
        writeln!(out, "{name:22}{value}")?;
    }
    out.write_str("</pre>")
}

fn json(counters: impl Iterator<Item = (&'static str, u32)>, out: &mut Response) -> fmt::Result {
    out.write_str(
        "HTTP/1.0 200 OK\r\nContent-Type: application/json\r\nConnection: close\r\n\r\n",
    )?;
    for (place, (name, value)) in counters.enumerate() {
        write!(out, "{}\"{name}\":{value}", if place == 0 { '{' } else { ',' })?;
    }
    out.write_str("}\n")
}

#[cfg(test)]
mod tests {
    extern crate std;

    use core::net::{Ipv4Addr, SocketAddrV4};

    use std::borrow::ToOwned as _;

    use super::*;
    use crate::settings::Settings;
    use crate::{Chip, mavlink_writer};

    fn crowded() -> Bridge {
        let mut settings = Settings::default();
        settings.set("wifi.password", "not to be shown").unwrap();
        let mut bridge = Bridge::new(HostTime::ZERO, settings, Chip::default());
        let mut packet = [0; 280];
        let len = mavlink_writer::write_packet(&mut packet, (255, 1), 0, 0, &[1; 9]);
        for last in 100..108 {
            let from = SocketAddrV4::new(Ipv4Addr::new(192, 168, 100, last), 60_000);
            bridge.handle_datagram(HostTime::ZERO, from, &packet[..len]);
        }
        bridge
    }

    /// Returns all parts of the answer to a request.
    fn answered(bridge: &mut Bridge, request: &str) -> std::string::String {
        let mut whole = Request::new();
        whole.push(request.as_bytes());
        let now = HostTime::from_ns(5_000_000_000);
        let done = act(bridge, now, &whole);
        let mut out = Response::new();
        (0..)
            .map_while(|part| {
                respond(bridge, now, &whole, done, part, &mut out).then(|| out.as_str().to_owned())
            })
            .collect()
    }

    #[test]
    fn pages_fit_and_reveal_no_secret() {
        let mut bridge = crowded();
        let mut check = |request: &str, expected: &[&str]| {
            let answer = answered(&mut bridge, request);
            for part in expected {
                assert!(answer.contains(part), "{request}: {answer}");
            }
            assert!(!answer.contains("shown"));
        };
        let all = ["200 OK", "no vehicle", "192.168.100.107:60000", "drop_uart_full", "--claim"];
        check("GET / HTTP/1.1\r\nHost: x\r\n\r\n", &all);
        check(
            "GET /stats.json HTTP/1.1\r\n\r\n",
            &["{\"uptime_s\":5,", "\"net_packets_in\":8,", "}\n"],
        );
        let six = ["vpackets", "vsent", "vlost", "gpackets", "gsent", "glost"];
        check("GET /status.json?r=1 HTTP/1.1\r\n\r\n", &six);
        let settings = ["LOSS_MS           1000", "wifi.password     ***", "<form method=post"];
        check("GET /settings HTTP/1.1\r\n\r\n", &settings);
        check("GET /setup HTTP/1.1\r\n\r\n", &["404"]);
        check("POST / HTTP/1.1\r\n\r\n", &["404"]);
        check("\u{0}\n\n", &["404"]);
    }

    fn post(body: &str, more: &str) -> std::string::String {
        std::format!(
            "POST /settings HTTP/1.1\r\n{more}Content-Length: {}\r\n\r\n{body}",
            body.len()
        )
    }

    #[test]
    fn settings_change_only_with_the_key() {
        let mut bridge = crowded();
        let change = "name=LOSS_MS&value=800&key=";
        let check = |bridge: &mut Bridge, request: &str, line: &str, loss_ms: u16| {
            let answer = answered(bridge, request);
            assert!(answer.starts_with(line), "{request}: {answer}");
            assert_eq!(bridge.settings().loss_ms, loss_ms, "{request}");
        };
        // A bridge without keys accepts no key, not even an empty one.
        check(&mut bridge, &post(change, ""), "HTTP/1.0 403", 1000);
        let mut settings = bridge.settings().clone();
        settings.set("page.key", "abcd-efgh-2345-6789").unwrap();
        let hex = "ab".repeat(32);
        settings.set("key", &hex).unwrap();
        let mut bridge = Bridge::new(HostTime::ZERO, settings, Chip::default());
        let right = post(&std::format!("{change}abcd-efgh-2345-6789"), "");
        let foreign =
            post(&std::format!("{change}abcd-efgh-2345-6789"), "Sec-Fetch-Site: cross-site\r\n");
        check(&mut bridge, &foreign, "HTTP/1.0 400", 1000);
        check(&mut bridge, &post("name=LOSS_MS&value=800", ""), "HTTP/1.0 400", 1000);
        check(&mut bridge, &right, "HTTP/1.0 200", 800);
        assert_eq!(bridge.poll_event(), Some(crate::Event::Save));
        check(
            &mut bridge,
            &post(&std::format!("name=LOSS_MS&value=700&key={hex}"), ""),
            "HTTP/1.0 200",
            700,
        );
        check(
            &mut bridge,
            &post(&std::format!("name=LOSS_MS&value=1&key={hex}"), ""),
            "HTTP/1.0 400",
            700,
        );
        check(
            &mut bridge,
            &post(&std::format!("{change}abcd-efgh-2345-678"), ""),
            "HTTP/1.0 403",
            700,
        );
        // After a wrong key, all keys are rejected for a moment.
        check(&mut bridge, &right, "HTTP/1.0 403", 700);
        let mut armed = [0; 280];
        let payload = [4, 0, 0, 0, 2, 3, 0x80 | 0x09, 4, 3];
        let len = mavlink_writer::write_packet(&mut armed, (1, 1), 0, 0, &payload);
        bridge.handle_uart(HostTime::from_ns(9_000_000_000), &armed[..len]);
        check(&mut bridge, &right, "HTTP/1.0 409", 700);
    }
}

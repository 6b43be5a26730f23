//! The status page: what a browser shows of a bridge, and the same as JSON. Reading only: settings
//! change by `vizflyt bridge configure`, with the key; a firmware comes here too, and its signature
//! speaks for it.

use core::fmt::{self, Write as _};

use heapless::String;
use vizflyt_protocol::time::HostTime;

use crate::bridge::{Bridge, LandingStage, Peer};
use crate::stats::REPORT;

/// Bytes of a response at most.
pub const RESPONSE: usize = 2048;

/// Answers an HTTP request by its first line.
pub fn respond(bridge: &Bridge, now: HostTime, request: &[u8]) -> String<RESPONSE> {
    let mut out = String::new();
    let written = match request {
        request if request.starts_with(b"GET / ") => page(bridge, now, &mut out),
        request if request.starts_with(b"GET /stats.json ") => json(bridge, now, &mut out),
        _ => out.write_str(
            "HTTP/1.0 404 Not Found\r\nConnection: close\r\n\r\nthere is / and /stats.json\n",
        ),
    };
    if written.is_err() {
        // More clients than fit: an error rather than half a page.
        out.clear();
        let _ = out
            .write_str("HTTP/1.0 500 Internal Server Error\r\nConnection: close\r\n\r\ntoo long\n");
    }
    out
}

/// Whether the end of the request's head has come.
pub fn is_whole(request: &[u8]) -> bool {
    body(request).is_some()
}

/// Returns where a new firmware begins in a request that brings one: `POST /update`, the signed file
/// as it is.
pub fn firmware(request: &[u8]) -> Option<usize> {
    body(request).filter(|_| request.starts_with(b"POST /update "))
}

/// Answers a request that brought a firmware.
pub fn respond_firmware(taken: Result<(), &str>) -> String<RESPONSE> {
    let mut out = String::new();
    // Fits: the longest reason is a sentence.
    let _ = match taken {
        Ok(()) => out.write_str(
            "HTTP/1.0 200 OK\r\nConnection: close\r\n\r\nverified; it starts now, on trial\n",
        ),
        Err(why) => {
            write!(out, "HTTP/1.0 409 Conflict\r\nConnection: close\r\n\r\n{why}\n")
        }
    };
    out
}

fn body(request: &[u8]) -> Option<usize> {
    request.windows(4).position(|end| end == b"\r\n\r\n").map(|at| at + 4)
}

fn counters(bridge: &Bridge, now: HostTime) -> impl Iterator<Item = (&'static str, u32)> {
    REPORT.iter().copied().zip(bridge.stats().report(bridge.uptime_s(now)))
}

fn page(bridge: &Bridge, now: HostTime, out: &mut String<RESPONSE>) -> fmt::Result {
    out.write_str("HTTP/1.0 200 OK\r\nContent-Type: text/html; charset=utf-8\r\n")?;
    out.write_str("Cache-Control: no-store\r\nConnection: close\r\n\r\n")?;
    out.write_str("<!doctype html><meta http-equiv=refresh content=2><title>bridge</title>")?;
    // The name is letters, digits and hyphens: nothing to escape.
    write!(out, "<h1>{}</h1><pre>", bridge.settings().hostname)?;
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
        writeln!(out, ": {sent} sent, {slow} too slow for")?;
    }
    for (name, value) in counters(bridge, now) {
        writeln!(out, "{name:22}{value}")?;
    }
    out.write_str("</pre>")
}

fn json(bridge: &Bridge, now: HostTime, out: &mut String<RESPONSE>) -> fmt::Result {
    out.write_str(
        "HTTP/1.0 200 OK\r\nContent-Type: application/json\r\nConnection: close\r\n\r\n",
    )?;
    for (place, (name, value)) in counters(bridge, now).enumerate() {
        write!(out, "{}\"{name}\":{value}", if place == 0 { '{' } else { ',' })?;
    }
    out.write_str("}\n")
}

#[cfg(test)]
mod tests {
    use core::net::{Ipv4Addr, SocketAddrV4};

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

    #[test]
    fn the_page_and_its_figures_fit_and_tell_no_secret() {
        let bridge = crowded();
        let check = |request: &str, expected: &[&str]| {
            let answer = respond(&bridge, HostTime::from_ns(5_000_000_000), request.as_bytes());
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
        check("GET /setup HTTP/1.1\r\n\r\n", &["404"]);
        check("POST / HTTP/1.1\r\n\r\n", &["404"]);
        check("\u{0}", &["404"]);
    }

    #[test]
    fn a_requests_end_is_found() {
        assert!(is_whole(b"GET / HTTP/1.0\r\n\r\n"));
        assert!(!is_whole(b"GET / HTTP/1.0\r\nHost: a\r\n"));
        assert!(!is_whole(b""));
    }
}

//! Who may see and do what on the page, over real HTTP to the real binary: every route as a
//! stranger, as a team, as the instructor, and from the server's own computer without a key.

mod support;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

use serde_json::Value;
use support::{PATIENCE, Server, write_arena};

/// The server, and the cookies of those who were given a key.
struct Lab {
    server: Server,
    instructor: String,
    ants: String,
    _folder: tempfile::TempDir,
}

/// A key that nobody has.
const STRANGER: &str = "vizflyt_key=00000000000000000000000000000000";

impl Lab {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let more = "[[vehicles]]\nname = \"ant\"\n[[vehicles]]\nname = \"bee\"\n";
        let server = Server::start(&write_arena(folder.path(), more), &["--print-page-keys"]);
        let mut links = ["instructor", "team of 'ant'"].map(|whose| {
            server.line(|line| {
                let key = &line["page_key"];
                (key["for"] == whose).then(|| key["link"].as_str().unwrap().to_owned())
            })
        });
        let own = format!("http://{}", server.http);
        let cookies = links.each_mut().map(|link| {
            let (status, head) =
                ask(server.http, &format!("GET {}", link.strip_prefix(&own).unwrap()), "", "");
            assert_eq!(status, 303, "{head}");
            let cookie = header(&head, "set-cookie").unwrap();
            for part in ["HttpOnly", "SameSite=Strict", "Path=/"] {
                assert!(cookie.contains(part), "{cookie}");
            }
            let to = header(&head, "location").unwrap();
            (cookie.split(';').next().unwrap().to_owned(), to)
        });
        let [(instructor, home), (ants, own_page)] = cookies;
        assert_eq!((home.as_str(), own_page.as_str()), ("/", "/?vehicle=ant"));
        Self { server, instructor, ants, _folder: folder }
    }

    /// Asks as our own page would.
    fn ask(&self, request: &str, cookie: &str) -> (u16, String) {
        let origin = format!("Origin: http://{}\r\n", self.server.http);
        ask(self.server.http, request, cookie, &origin)
    }

    fn status(&self, request: &str, cookie: &str) -> u16 {
        self.ask(request, cookie).0
    }
}

/// Sends a request; returns the status, and head and body.
fn ask(address: SocketAddr, request: &str, cookie: &str, more: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let cookie = if cookie.is_empty() { String::new() } else { format!("Cookie: {cookie}\r\n") };
    let upgrade = if request.contains("/ws") {
        "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    } else {
        "Connection: close\r\n"
    };
    write!(
        stream,
        "{request} HTTP/1.1\r\nHost: {address}\r\n{cookie}{more}{upgrade}Content-Length: 0\r\n\r\n"
    )
    .unwrap();
    let mut answer = Vec::new();
    let mut chunk = [0; 1024];
    loop {
        match stream.read(&mut chunk).unwrap() {
            0 => break,
            count => answer.extend_from_slice(&chunk[..count]),
        }
        // A connection that may become a WebSocket stays open, whatever the answer.
        let text = String::from_utf8_lossy(&answer);
        let Some((head, body)) = text.split_once("\r\n\r\n") else { continue };
        let len = header(head, "content-length").map(|len| len.parse::<usize>().unwrap());
        if head.starts_with("HTTP/1.1 101") || len.is_some_and(|len| body.len() >= len) {
            break;
        }
    }
    let answer = String::from_utf8_lossy(&answer).into_owned();
    (answer.split(' ').nth(1).unwrap().parse().unwrap(), answer)
}

fn header(answer: &str, name: &str) -> Option<String> {
    answer.lines().take_while(|line| !line.is_empty()).find_map(|line| {
        let (key, value) = line.split_once(": ")?;
        key.eq_ignore_ascii_case(name).then(|| value.to_owned())
    })
}

/// What a request takes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Takes {
    Nothing,
    AnyKey,
    Ants,
    Bees,
    All,
}

/// Every route, and some that are not there.
const ROUTES: &[(&str, Takes)] = &[
    ("GET /", Takes::Nothing),
    ("GET /style.css", Takes::Nothing),
    ("GET /app.js", Takes::Nothing),
    ("GET /map.js", Takes::Nothing),
    ("GET /cameras.js", Takes::Nothing),
    ("GET /waterfall.js", Takes::Nothing),
    ("GET /pairing.js", Takes::Nothing),
    ("GET /icon.svg", Takes::Nothing),
    ("GET /api/map", Takes::AnyKey),
    ("GET /api/vehicles", Takes::AnyKey),
    ("GET /ws?vehicle=ant", Takes::Ants),
    ("GET /ws?vehicle=bee", Takes::Bees),
    ("GET /ws", Takes::All),
    ("GET /ws?vehicle=ant&vehicle=bee", Takes::All),
    ("GET /api/stats?vehicle=ant", Takes::Ants),
    ("GET /api/stats?vehicle=bee", Takes::Bees),
    ("GET /api/stats", Takes::All),
    ("GET /api/vehicles/ant/cameras", Takes::Ants),
    ("GET /api/vehicles/bee/cameras", Takes::Bees),
    ("POST /api/vehicles/ant/estop", Takes::Ants),
    ("POST /api/vehicles/bee/estop", Takes::Bees),
    ("POST /api/vehicles/%62ee/estop", Takes::Bees),
    ("PUT /api/vehicles/ant/cameras/front", Takes::All),
    ("PATCH /api/vehicles/ant/cameras/front", Takes::All),
    ("POST /api/estop", Takes::All),
    ("GET /api/pairing", Takes::All),
    ("POST /api/pairing", Takes::All),
    ("DELETE /api/pairing", Takes::All),
    ("GET /api/cameras", Takes::All),
    ("PATCH /api/cameras/front", Takes::All),
    ("GET /api/of-tomorrow", Takes::All),
    ("GET /nothing", Takes::All),
];

#[test]
fn every_route_knows_a_stranger_a_team_and_the_instructor() {
    let lab = Lab::start();
    for &(request, takes) in ROUTES {
        let stranger = lab.status(request, STRANGER);
        assert_eq!(stranger == 401, takes != Takes::Nothing, "stranger: {request}: {stranger}");
        let team = lab.status(request, &lab.ants);
        let may = matches!(takes, Takes::Nothing | Takes::AnyKey | Takes::Ants);
        assert_eq!(team == 403, !may, "team: {request}: {team}");
        for boss in [lab.instructor.as_str(), ""] {
            let status = lab.status(request, boss);
            assert!(status != 401 && status != 403, "instructor: {request}: {status}");
        }
    }
}

#[test]
fn a_stranger_neither_watches_nor_stops() {
    let lab = Lab::start();
    let (status, answer) = lab.ask("POST /api/estop", STRANGER);
    assert!(status == 401 && answer.contains("this page needs a key"), "{answer}");
    for secret in ["ant", "bee", "wall"] {
        assert!(!answer.contains(secret), "{answer}");
    }
    assert_eq!(lab.status("POST /api/vehicles/ant/estop", STRANGER), 401);
    assert_eq!(lab.status("GET /ws?vehicle=ant", STRANGER), 401);
    // A wrong key gives nothing, and takes away what the browser had.
    let (status, head) = lab.ask("GET /enter?key=wrong", STRANGER);
    assert_eq!(status, 401);
    assert!(header(&head, "set-cookie").unwrap().starts_with("vizflyt_key=; "), "{head}");
}

#[test]
fn a_team_stops_its_own_vehicle_and_no_other() {
    let lab = Lab::start();
    // Nobody flies, which the server says only to those who may know.
    assert_eq!(lab.status("POST /api/vehicles/ant/estop", &lab.ants), 409);
    assert_eq!(lab.status("POST /api/vehicles/bee/estop", &lab.ants), 403);
    assert_eq!(lab.status("POST /api/estop", &lab.ants), 403);
    let (_, answer) = lab.ask("GET /api/vehicles", &lab.ants);
    let list: Value = serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap();
    let names: Vec<_> = list.as_array().unwrap().iter().map(|v| v["name"].as_str()).collect();
    assert_eq!(names, [Some("ant")]);
}

/// A page elsewhere cannot use the cookie or the computer of someone who may.
#[test]
fn another_page_acts_for_nobody() {
    let lab = Lab::start();
    let elsewhere = "Origin: http://evil.example\r\n";
    for request in ["POST /api/vehicles/ant/estop", "POST /api/pairing", "GET /ws?vehicle=ant"] {
        for cookie in [lab.ants.as_str(), lab.instructor.as_str(), ""] {
            let (status, answer) = ask(lab.server.http, request, cookie, elsewhere);
            assert_eq!(status, 403, "{request}: {answer}");
        }
    }
    // Its own name, made to resolve to us, does not read as us either.
    let mut stream = TcpStream::connect(lab.server.http).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET /api/pairing HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n")
        .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
}

#[test]
fn the_page_opens_a_pairing_and_closes_it() {
    let lab = Lab::start();
    let standing = |request: &str, body: &str| {
        let (status, answer) = support::send_json(lab.server.http, request, None, body);
        (status, serde_json::from_str::<Value>(&answer).unwrap_or(Value::Null))
    };
    assert_eq!(standing("GET /api/pairing", "").1["open"], Value::Null);
    assert_eq!(standing("POST /api/pairing", r#"{"right": "team:wasp"}"#).0, 400);
    assert_eq!(standing("POST /api/pairing", r#"{"right": "boss"}"#).0, 400);
    let (status, opened) = standing("POST /api/pairing", r#"{"right": "team:ant"}"#);
    assert_eq!((status, &opened["open"]["right"]), (200, &"ant".into()));
    assert_eq!(opened["open"]["code"].as_str().unwrap().len(), 7);
    assert_eq!(standing("GET /api/pairing", "").1["open"]["code"], opened["open"]["code"]);
    assert_eq!(standing("POST /api/pairing", r#"{"right": "instructor"}"#).0, 409);
    assert_eq!(standing("DELETE /api/pairing", "").1["open"], Value::Null);
}

//! Rights on the page, over real HTTP to the real binary: every route as a stranger, as a team, as the instructor, and
//! from the server's own computer without a key.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

use crate::support::{Emitter, PATIENCE, Server, Socket, write_arena};
use serde_json::Value;
use vizflyt_server::web::Takes as DeclaredTakes;

/// The server, and the cookies of viewers with a key.
struct Lab {
    server: Server,
    instructor: String,
    ants: String,
    _folder: tempfile::TempDir,
}

/// A wrong key.
const STRANGER: &str = "vizflyt_key=00000000000000000000000000000000";

impl Lab {
    fn start() -> Self {
        Self::start_with(&[])
    }

    fn start_with(options: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let more = "[[vehicles]]\nname = \"ant\"\n[[vehicles]]\nname = \"bee\"\n";
        let server = Server::start(
            &write_arena(folder.path(), more),
            &[&["--print-page-keys"], options].concat(),
        );
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

    /// Sends a request as the page does: with the token of the cookie.
    fn ask(&self, request: &str, cookie: &str) -> (u16, String) {
        let token = standing(self.server.http, cookie)["token"].as_str().map(str::to_owned);
        let token = token.map_or_else(String::new, |t| format!("X-VizFlyt-Token: {t}\r\n"));
        let more = format!("Origin: http://{}\r\n{token}", self.server.http);
        ask(self.server.http, request, cookie, &more)
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
        // A connection that may become a WebSocket stays open after any answer.
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

/// Returns the session as the page receives it.
fn standing(address: SocketAddr, cookie: &str) -> Value {
    let (status, answer) = ask(address, "GET /api/session", cookie, "");
    assert_eq!(status, 200, "{answer}");
    assert_eq!(header(&answer, "cache-control").as_deref(), Some("no-store"));
    serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap()
}

/// Logs in; returns the status, the cookie, and the answer.
fn log_in(address: SocketAddr, password: &str) -> (u16, String, String) {
    let body = serde_json::json!({ "password": password }).to_string();
    let (status, answer) = raw(
        address,
        &format!(
            "POST /api/login HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\n\
             Connection: close\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        ),
    );
    let cookie = header(&answer, "set-cookie").unwrap_or_default();
    (status, cookie, answer)
}

/// Sends bytes; returns the status and the complete answer.
fn raw(address: SocketAddr, request: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let answer = String::from_utf8_lossy(&answer).into_owned();
    (answer.split(' ').nth(1).unwrap().parse().unwrap(), answer)
}

fn header(answer: &str, name: &str) -> Option<String> {
    answer.lines().take_while(|line| !line.is_empty()).find_map(|line| {
        let (key, value) = line.split_once(": ")?;
        key.eq_ignore_ascii_case(name).then(|| value.to_owned())
    })
}

/// Right that a request requires.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Takes {
    Nothing,
    AnyKey,
    Ants,
    Bees,
    All,
}

/// Every route, and some that do not exist.
const ROUTES: &[(&str, Takes)] = &[
    ("GET /", Takes::Nothing),
    ("GET /app.js", Takes::Nothing),
    ("GET /best_run.js", Takes::Nothing),
    ("GET /closing.js", Takes::Nothing),
    ("GET /connection.js", Takes::Nothing),
    ("GET /dialog.js", Takes::Nothing),
    ("GET /dialogs/environment.js", Takes::Nothing),
    ("GET /dialogs/login.js", Takes::Nothing),
    ("GET /dialogs/pairing.js", Takes::Nothing),
    ("GET /dialogs/panels.js", Takes::Nothing),
    ("GET /dialogs/scene.js", Takes::Nothing),
    ("GET /dom.js", Takes::Nothing),
    ("GET /draw_rate.js", Takes::Nothing),
    ("GET /event_groups.js", Takes::Nothing),
    ("GET /event_kinds.js", Takes::Nothing),
    ("GET /fleet.js", Takes::Nothing),
    ("GET /flight_file.js", Takes::Nothing),
    ("GET /flight_recording.js", Takes::Nothing),
    ("GET /flight_store.js", Takes::Nothing),
    ("GET /header.js", Takes::Nothing),
    ("GET /layout.js", Takes::Nothing),
    ("GET /icon.svg", Takes::Nothing),
    ("GET /lab", Takes::Nothing),
    ("GET /lab.css", Takes::Nothing),
    ("GET /lab.js", Takes::Nothing),
    ("GET /orders.js", Takes::Nothing),
    ("GET /outcome.js", Takes::Nothing),
    ("GET /panels.js", Takes::Nothing),
    ("GET /panels/arena_view.js", Takes::Nothing),
    ("GET /panels/camera_images.js", Takes::Nothing),
    ("GET /panels/camera_settings.js", Takes::Nothing),
    ("GET /panels/crash_card.js", Takes::Nothing),
    ("GET /panels/events.js", Takes::Nothing),
    ("GET /panels/sensors.js", Takes::Nothing),
    ("GET /panels/figures.js", Takes::Nothing),
    ("GET /panels/leaderboard.js", Takes::Nothing),
    ("GET /panels/timing.js", Takes::Nothing),
    ("GET /phases.js", Takes::Nothing),
    ("GET /replay_bar.js", Takes::Nothing),
    ("GET /session.js", Takes::Nothing),
    ("GET /socket.js", Takes::Nothing),
    ("GET /space_drawing.js", Takes::Nothing),
    ("GET /space_flat.js", Takes::Nothing),
    ("GET /space_others.js", Takes::Nothing),
    ("GET /space_room.js", Takes::Nothing),
    ("GET /space_served.js", Takes::Nothing),
    ("GET /space_track.js", Takes::Nothing),
    ("GET /space_twin.js", Takes::Nothing),
    ("GET /space_view.js", Takes::Nothing),
    ("GET /splat_worker.js", Takes::Nothing),
    ("GET /splats.js", Takes::Nothing),
    ("GET /standings.js", Takes::Nothing),
    ("GET /stop.js", Takes::Nothing),
    ("GET /style.css", Takes::Nothing),
    ("GET /theme.js", Takes::Nothing),
    ("GET /three/three.core.min.js", Takes::Nothing),
    ("GET /three/three.module.min.js", Takes::Nothing),
    ("GET /top_view.js", Takes::Nothing),
    ("GET /vehicle_tags.js", Takes::Nothing),
    ("GET /wall", Takes::Nothing),
    ("GET /wall.css", Takes::Nothing),
    ("GET /wall.js", Takes::Nothing),
    ("GET /wall_flight.js", Takes::Nothing),
    ("GET /api/leaderboard", Takes::AnyKey),
    // By the team's token, from any sender.
    ("PUT /api/vehicles/ant/team", Takes::Nothing),
    ("POST /api/vehicles/ant/team", Takes::All),
    ("DELETE /api/vehicles/ant/team", Takes::Ants),
    ("GET /api/lab", Takes::AnyKey),
    ("GET /api/lab/report.pdf", Takes::All),
    ("POST /api/lab/sign", Takes::All),
    ("POST /api/lab/axes", Takes::All),
    ("POST /api/lab/evidence", Takes::All),
    ("POST /api/lab/queue", Takes::AnyKey),
    ("DELETE /api/lab/queue/7", Takes::AnyKey),
    ("POST /api/lab/turn", Takes::All),
    ("PUT /api/lab/formation", Takes::All),
    ("POST /api/lab/begin", Takes::All),
    ("GET /enter", Takes::Nothing),
    ("GET /api/session", Takes::Nothing),
    ("POST /api/login", Takes::Nothing),
    ("POST /api/logout", Takes::AnyKey),
    ("GET /api/map", Takes::AnyKey),
    ("GET /api/shell", Takes::All),
    ("GET /api/splats/0", Takes::All),
    ("GET /api/twin", Takes::All),
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
    ("GET /api/vehicles/ant/sensors", Takes::Ants),
    ("GET /api/vehicles/bee/sensors", Takes::Bees),
    ("GET /api/vehicles/ant/sensors/top/reading", Takes::Ants),
    ("GET /api/vehicles/bee/sensors/top/reading", Takes::Bees),
    ("PATCH /api/vehicles/ant/sensors/top", Takes::All),
    ("GET /api/vehicles/ant/crash", Takes::Ants),
    ("GET /api/vehicles/bee/crash", Takes::Bees),
    ("GET /api/vehicles/ant/crash/1/0/colour/0", Takes::Ants),
    ("GET /api/vehicles/bee/crash/1/0/depth/0", Takes::Bees),
    ("POST /api/vehicles/ant/estop", Takes::Ants),
    ("POST /api/vehicles/ant/start", Takes::All),
    ("POST /api/vehicles/ant/reset", Takes::All),
    ("POST /api/vehicles/ant/land", Takes::Ants),
    ("POST /api/vehicles/bee/land", Takes::Bees),
    ("POST /api/vehicles/bee/estop", Takes::Bees),
    ("POST /api/vehicles/%62ee/estop", Takes::Bees),
    ("PUT /api/vehicles/ant/cameras/front", Takes::All),
    ("PATCH /api/vehicles/ant/cameras/front", Takes::All),
    ("POST /api/estop", Takes::All),
    ("GET /api/pairing", Takes::All),
    ("GET /api/scenes", Takes::All),
    ("PUT /api/scene", Takes::All),
    ("GET /api/environment", Takes::All),
    ("PUT /api/environment", Takes::All),
    ("POST /api/pairing", Takes::All),
    ("DELETE /api/pairing", Takes::All),
    ("GET /api/cameras", Takes::All),
    ("PATCH /api/cameras/front", Takes::All),
    ("GET /api/of-tomorrow", Takes::All),
    ("GET /nothing", Takes::All),
];

#[test]
fn every_route_checks_the_rights_of_strangers_teams_and_the_instructor() {
    let lab = Lab::start();
    for &(request, takes) in ROUTES {
        let stranger = lab.status(request, STRANGER);
        // Entering without a key is rejected for that.
        let is_refused = takes != Takes::Nothing || request == "GET /enter";
        assert_eq!(stranger == 401, is_refused, "stranger: {request}: {stranger}");
        let team = lab.status(request, &lab.ants);
        let may = matches!(takes, Takes::Nothing | Takes::AnyKey | Takes::Ants);
        assert_eq!(team == 403, !may, "team: {request}: {team}");
        for boss in [lab.instructor.as_str(), ""] {
            let status = lab.status(request, boss);
            let is_let_in = (status != 401 || request == "GET /enter") && status != 403;
            assert!(is_let_in, "instructor: {request}: {status}");
        }
    }
}

/// Compares the list above with the table that makes the router: a new route fails here until its right is listed.
#[test]
fn every_route_of_the_server_is_listed_here() {
    for (method, path, takes) in vizflyt_server::web::routes() {
        let is_it = |asked: &str| {
            let (m, p) = asked.split_once(' ').unwrap();
            let parts: Vec<_> = p.split('?').next().unwrap().split('/').collect();
            let wanted: Vec<_> = path.split('/').collect();
            let fits = |(part, want): (&&str, &&str)| want.starts_with('{') || part == want;
            m == method && parts.len() == wanted.len() && parts.iter().zip(&wanted).all(fits)
        };
        let expected: Vec<_> = ROUTES.iter().filter(|(asked, _)| is_it(asked)).collect();
        assert!(!expected.is_empty(), "{method} {path} is walked by no test");
        for (asked, expected) in expected {
            let fits = match expected {
                Takes::Nothing => takes == DeclaredTakes::Nothing,
                Takes::AnyKey => takes == DeclaredTakes::Key,
                Takes::Ants | Takes::Bees => takes == DeclaredTakes::Vehicle,
                // Without a vehicle, the right to all is required.
                Takes::All => matches!(takes, DeclaredTakes::Everything | DeclaredTakes::Vehicle),
            };
            assert!(fits, "{asked}: {takes:?}, not {expected:?}");
        }
    }
}

/// Requests that change something require the token of their cookie; the stop button does not.
#[test]
fn a_cookie_without_its_token_changes_nothing() {
    let lab = Lab::start();
    let address = lab.server.http;
    let origin = format!("Origin: http://{address}\r\n");
    let of_the_team = standing(address, &lab.ants)["token"].as_str().unwrap().to_owned();
    assert_eq!(of_the_team.len(), 64);
    assert_eq!(
        standing(address, "")["token"],
        Value::Null,
        "the server's own computer has no cookie"
    );
    for request in [
        "POST /api/pairing",
        "DELETE /api/pairing",
        "PUT /api/vehicles/ant/cameras/front",
        "PATCH /api/vehicles/ant/cameras/front",
        "POST /api/vehicles/ant/start",
        "POST /api/vehicles/ant/land",
        "POST /api/vehicles/ant/reset",
        "POST /api/vehicles/ant/team",
        "DELETE /api/vehicles/ant/team",
        "PUT /api/scene",
        "PUT /api/environment",
        "POST /api/lab/sign",
        "POST /api/lab/queue",
        "DELETE /api/lab/queue/1",
        "PUT /api/lab/formation",
        "POST /api/lab/begin",
        "POST /api/logout",
    ] {
        for token in ["", "00", &of_the_team] {
            let more = format!("{origin}X-VizFlyt-Token: {token}\r\n");
            let (status, answer) = ask(address, request, &lab.instructor, &more);
            assert!(status == 403 && answer.contains("X-VizFlyt-Token"), "{request}: {answer}");
        }
        let status = lab.status(request, &lab.instructor);
        assert!(![401, 403].contains(&status), "{request}: {status}");
    }
    assert_eq!(ask(address, "POST /api/vehicles/ant/estop", &lab.instructor, &origin).0, 409);
}

#[test]
fn the_password_opens_a_session_until_it_changes() {
    let lab = Lab::start_with(&["--login", "always"]);
    let (address, folder) = (lab.server.http, lab.server.keys());
    // The server's own computer is not the instructor without a login.
    assert_eq!(lab.status("GET /api/pairing", ""), 401);
    let (status, cookie, answer) = log_in(address, "correct horse battery");
    assert_eq!((status, cookie.as_str()), (409, ""), "{answer}");
    assert!(answer.contains("vizflyt password"));
    assert_eq!(standing(address, "")["password"], false);
    vizflyt_server::web::set_password(&folder, "correct horse battery").unwrap();
    assert_eq!(standing(address, "")["password"], true);
    let (status, cookie, answer) = log_in(address, "correct horse");
    assert!(status == 401 && cookie.is_empty() && answer.contains("not the password"), "{answer}");
    let (status, cookie, answer) = log_in(address, "correct horse battery");
    assert_eq!(status, 200, "{answer}");
    for part in ["HttpOnly", "SameSite=Strict", "Path=/"] {
        assert!(cookie.contains(part) && !cookie.contains("Secure"), "{cookie}");
    }
    let cookie = cookie.split(';').next().unwrap().to_owned();
    let told = standing(address, &cookie);
    assert_eq!((&told["role"], &told["by"]), (&"instructor".into(), &"password".into()));
    assert_eq!(lab.status("GET /api/pairing", &cookie), 200);
    // Logging out; a new password also ends the sessions of the old one.
    assert_eq!(lab.status("POST /api/logout", &cookie), 204);
    assert_eq!(lab.status("GET /api/pairing", &cookie), 401);
    let cookie = log_in(address, "correct horse battery").1;
    let cookie = cookie.split(';').next().unwrap().to_owned();
    assert_eq!(lab.status("GET /api/pairing", &cookie), 200);
    vizflyt_server::web::set_password(&folder, "another one altogether").unwrap();
    assert_eq!(lab.status("GET /api/pairing", &cookie), 401);
    assert_eq!(log_in(address, "correct horse battery").0, 401);
    assert_eq!(log_in(address, "another one altogether").0, 200);
    // The attempts run out; then the right password must wait too.
    let guesses: Vec<_> = (0..30).map(|k| log_in(address, &format!("guess {k}")).0).collect();
    assert!(
        guesses.contains(&429) && guesses.iter().all(|s| [401, 429].contains(s)),
        "{guesses:?}"
    );
}

#[test]
fn refuses_large_requests_and_paths_out_of_the_folder() {
    let lab = Lab::start();
    let address = lab.server.http;
    for path in [
        "/../Cargo.toml",
        "/..%2fCargo.toml",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/style.css/../../keys/server.key",
        "/api/vehicles/..%2f..%2fant/cameras",
        "/api/vehicles/ant/cameras/..%2f..",
        "//etc/passwd",
    ] {
        let request =
            format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        let (status, answer) = raw(address, &request);
        assert!((400..500).contains(&status), "{path}: {status}");
        assert!(!answer.contains("root:") && !answer.contains("BEGIN"), "{path}");
    }
    for request in [
        "POST /api/login",
        "POST /api/pairing",
        "PUT /api/vehicles/ant/cameras/front",
        "PATCH /api/vehicles/ant/cameras/front",
    ] {
        let (status, answer) = crate::support::send_json(
            address,
            request,
            None,
            &format!("\"{}\"", "x".repeat(1 << 20)),
        );
        assert_eq!(status, 413, "{request}: {answer}");
    }
}

#[test]
fn a_stranger_can_neither_watch_nor_stop() {
    let lab = Lab::start();
    let (status, answer) = lab.ask("POST /api/estop", STRANGER);
    assert!(status == 401 && answer.contains("this page needs a key"), "{answer}");
    for secret in ["ant", "bee", "wall"] {
        assert!(!answer.contains(secret), "{answer}");
    }
    assert_eq!(lab.status("POST /api/vehicles/ant/estop", STRANGER), 401);
    assert_eq!(lab.status("GET /ws?vehicle=ant", STRANGER), 401);
    // A wrong key sets no cookie.
    let (status, head) = lab.ask("GET /enter?key=wrong", STRANGER);
    assert_eq!((status, header(&head, "set-cookie")), (401, None), "{head}");
}

/// Any page on the Internet can open `/enter` in the instructor's browser.
#[test]
fn other_pages_cannot_replace_the_instructors_key() {
    let lab = Lab::start();
    let address = lab.server.http;
    let (_, team_key) = lab.ants.split_once('=').unwrap();
    for path in ["/enter", "/enter?key=", "/enter?key=wrong"] {
        let (status, head) = ask(address, &format!("GET {path}"), &lab.instructor, "");
        assert_eq!((status, header(&head, "set-cookie")), (401, None), "{path}: {head}");
    }
    let (status, head) = ask(address, &format!("GET /enter?key={team_key}"), &lab.instructor, "");
    let set = header(&head, "set-cookie").unwrap();
    let set = set.split(';').next().unwrap();
    assert_eq!((status, set), (303, lab.ants.as_str()));
    let both = [format!("{set}; {}", lab.instructor), format!("{}; {set}", lab.instructor)];
    for both in &both {
        assert_eq!(standing(address, both)["role"], "instructor", "{both}");
        assert_eq!(lab.status("POST /api/estop", both), 409);
    }
    // Only with the origin of the server's page, not for a page of another site.
    let elsewhere = "Origin: http://evil.example\r\n";
    let (status, head) = ask(address, &format!("GET /enter?key={team_key}"), "", elsewhere);
    assert_eq!((status, header(&head, "set-cookie")), (403, None), "{head}");
    let request = format!(
        "GET /enter?key={team_key} HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n"
    );
    let (status, head) = raw(address, &request);
    assert_eq!((status, header(&head, "set-cookie")), (403, None), "{head}");
    // Logging out deletes both keys.
    assert_eq!(lab.status("POST /api/logout", &both[0]), 204);
}

#[test]
fn a_team_stops_its_own_vehicle_and_no_other() {
    let lab = Lab::start();
    // No vehicle flies; the server returns that only to viewers with the right.
    assert_eq!(lab.status("POST /api/vehicles/ant/estop", &lab.ants), 409);
    assert_eq!(lab.status("POST /api/vehicles/bee/estop", &lab.ants), 403);
    assert_eq!(lab.status("POST /api/estop", &lab.ants), 403);
    let (_, answer) = lab.ask("GET /api/vehicles", &lab.ants);
    let list: Value = serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap();
    let names: Vec<_> = list.as_array().unwrap().iter().map(|v| v["name"].as_str()).collect();
    assert_eq!(names, [Some("ant")]);
}

#[test]
fn a_team_sees_only_its_own_vehicle_and_the_instructor_all() {
    let lab = Lab::start();
    let _emitters = ["ant", "bee"].map(|name| Emitter::start(lab.server.vicon, name));
    let watch = |cookie: &str| {
        // Header lines of a page with the cookie.
        let origin = format!("http://{}\r\nCookie: {cookie}", lab.server.http);
        let mut socket = Socket::open_at(lab.server.http, &origin, "/ws?vehicle=ant").unwrap();
        let mut tracks = vec![socket.message("track")["vehicle"].clone()];
        let state = loop {
            let (opcode, payload) = socket.next();
            if opcode != 1 {
                continue;
            }
            let message: Value = serde_json::from_slice(&payload).unwrap();
            match message["type"].as_str().unwrap() {
                "track" => tracks.push(message["vehicle"].clone()),
                "state" if !message["pose"].is_null() => break message,
                _ => {}
            }
        };
        (tracks, state, socket)
    };
    let (tracks, state, _) = watch(&lab.ants);
    assert_eq!((tracks, &state["others"]), (vec!["ant".into()], &serde_json::json!([])));
    let (tracks, mut state, mut socket) = watch(&lab.instructor);
    assert_eq!(tracks, ["ant", "bee"]);
    while state["others"][0]["pose"].is_null() {
        state = socket.message("state");
    }
    let others = state["others"].as_array().unwrap();
    assert_eq!((others.len(), &others[0]["name"]), (1, &"bee".into()));
}

#[test]
fn a_page_of_another_site_cannot_use_cookie_or_address() {
    let lab = Lab::start();
    let elsewhere = "Origin: http://evil.example\r\n";
    for request in ["POST /api/vehicles/ant/estop", "POST /api/pairing", "GET /ws?vehicle=ant"] {
        for cookie in [lab.ants.as_str(), lab.instructor.as_str(), ""] {
            let (status, answer) = ask(lab.server.http, request, cookie, elsewhere);
            assert_eq!(status, 403, "{request}: {answer}");
        }
    }
    // DNS rebinding: a foreign name that resolves to this address does not count as this server.
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
        let (status, answer) = crate::support::send_json(lab.server.http, request, None, body);
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

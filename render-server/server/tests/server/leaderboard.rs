//! Flights through a running server onto the leaderboard: check-in, verdict, standings, and a killed server.

use std::io::{Read, Write};

use crate::support::{Client, Emitter, Server, Socket, http, send_json, write_arena};
use quinn::TransportConfig;
use serde_json::Value;
use vizflyt_protocol::messages::{FlightPhase, Telemetry, ToServer};
use vizflyt_server::flights::leaderboard::{Attempt, Database, Leaderboard, Run, RunState};

/// Reads the board until it is as wanted: another task writes runs after their messages.
async fn until(board: &Leaderboard, wanted: impl Fn(&[Run]) -> bool) -> Vec<Run> {
    for _ in 0..600 {
        let runs = board.runs(None).await.unwrap();
        if wanted(&runs) {
            return runs;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    panic!("the board stays as it is: {:?}", board.runs(None).await.unwrap());
}

fn put(server: &Server, body: &str) -> (u16, String) {
    send_json(server.http, "PUT /api/vehicles/vizflyt/team", None, body)
}

/// As [`send_json`], from another address of this computer, with a cookie and its token.
fn send_json_as(
    to: std::net::SocketAddr,
    request: &str,
    from: &str,
    cookie: &str,
    body: &str,
) -> (u16, String) {
    let (_, session) = http(to, &format!("GET /api/session HTTP/1.1\r\nCookie: {cookie}"));
    let session: Value = serde_json::from_str(session.split_once("\r\n\r\n").unwrap().1).unwrap();
    let token = session["token"].as_str().unwrap_or_default();
    let socket = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
    socket.bind(&format!("{from}:0").parse::<std::net::SocketAddr>().unwrap().into()).unwrap();
    socket.connect(&to.into()).unwrap();
    let mut stream = std::net::TcpStream::from(socket);
    let len = body.len();
    write!(
        stream,
        "{request} HTTP/1.1\r\nHost: {to}\r\nOrigin: http://{to}\r\nCookie: {cookie}\r\n\
         X-VizFlyt-Token: {token}\r\nContent-Type: application/json\r\nConnection: close\r\n\
         Content-Length: {len}\r\n\r\n{body}"
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let status = answer.split(' ').nth(1).unwrap().parse().unwrap();
    (status, answer.split_once("\r\n\r\n").unwrap().1.to_owned())
}

fn standings_as(server: &Server, cookie: &str) -> Value {
    let (_, answer) =
        http(server.http, &format!("GET /api/leaderboard HTTP/1.1\r\nCookie: {cookie}"));
    serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap()
}

fn standings(server: &Server) -> Value {
    let (status, answer) = http(server.http, "GET /api/leaderboard HTTP/1.1");
    assert_eq!(status, 200, "{answer}");
    serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap()
}

/// Reports phases; waits for each in the page's state before the next.
async fn report(client: &mut Client, socket: &mut Socket, phases: &[(FlightPhase, &str)]) {
    for &(phase, name) in phases {
        client.send(&ToServer::Telemetry(Telemetry { phase, ..Telemetry::default() })).await;
        while socket.message("state")["report"]["phase"] != name {}
    }
}

// Two threads: one waits for the page's answers while the other keeps the connection alive.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_team_checks_in_flies_and_is_ranked() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("runs.sqlite");
    let board = Leaderboard::open(&Database::File(file.clone())).await.unwrap();
    let token = board.add_team("wasps").await.unwrap();
    let option = format!("--leaderboard={}", file.display());
    let arena = write_arena(folder.path(), "");
    let server = Server::start(&arena, &[&option, "--official-attempts=1"]);

    // Wrong tokens are reported and rate-limited.
    let (status, text) = put(&server, r#"{"token": "guess"}"#);
    assert_eq!((status, text.as_str()), (401, "no team has this token"));
    assert_eq!(put(&server, r#"{"attempt": "official"}"#).0, 400);
    let (status, text) = put(&server, &format!(r#"{{"token": "{token}", "attempt": "official"}}"#));
    assert_eq!((status, text.as_str()), (200, "wasps flies vizflyt next: official"));
    assert_eq!(standings(&server)["vehicles"][0]["team"], "wasps");

    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let (mut client, _) = Client::welcomed(&server, TransportConfig::default()).await;
    let own = format!("http://{}", server.http);
    let mut socket = Socket::open(server.http, &own).ok().unwrap();
    report(&mut client, &mut socket, &[(FlightPhase::Flying, "flying")]).await;
    let flying = until(&board, |runs| runs.len() == 1).await;
    assert_eq!((flying[0].state, flying[0].attempt), (RunState::Flying, Attempt::Official));
    assert_eq!(flying[0].team.as_deref(), Some("wasps"));
    let landing = [(FlightPhase::Landing, "landing"), (FlightPhase::Landed, "landed")];
    report(&mut client, &mut socket, &landing).await;
    until(&board, |runs| runs[0].state == RunState::Ended).await;
    let stand = standings(&server);
    assert_eq!(stand["official"][0]["team"], "wasps");
    assert_eq!(stand["official"][0]["stages_passed"], 0);
    let verdict = board.verdict(&flying[0].id).await.unwrap().unwrap();
    let verdict: Value = serde_json::from_str(&verdict).unwrap();
    assert!(verdict["outcome"].is_string() && verdict["seconds"].is_number(), "{verdict}");

    // A second flight is practice: the team has flown its only official attempt.
    let (status, text) = send_json(server.http, "POST /api/vehicles/vizflyt/reset", Some(&own), "");
    assert_eq!(status, 202, "{text}");
    report(&mut client, &mut socket, &[(FlightPhase::Flying, "flying")]).await;
    let runs = until(&board, |runs| runs.len() == 2).await;
    let second = runs.iter().find(|run| run.id != flying[0].id).unwrap();
    assert_eq!((second.attempt, second.state), (Attempt::Practice, RunState::Flying));

    // Killed during the flight: the first run is complete, the second has no verdict.
    server.kill();
    let again = Leaderboard::open(&Database::File(file)).await.unwrap();
    let after = again.runs(None).await.unwrap();
    assert_eq!(after.len(), 2);
    assert!(after.iter().any(|run| run.id == flying[0].id && run.state == RunState::Ended));
    assert!(after.iter().any(|run| run.id == second.id && run.state == RunState::Flying));
}

#[test]
fn the_instructor_checks_teams_in_and_strangers_cannot() {
    let folder = tempfile::tempdir().unwrap();
    let option = format!("--leaderboard={}", folder.path().join("runs.sqlite").display());
    let server = Server::start(&write_arena(folder.path(), ""), &[&option]);
    let own = format!("http://{}", server.http);
    let lease =
        |body: &str| send_json(server.http, "POST /api/vehicles/vizflyt/team", Some(&own), body);
    let (status, text) = lease(r#"{"team": "bees"}"#);
    assert!(status == 404 && text.contains("vizflyt leaderboard team add NAME"), "{text}");
    for _ in 0..20 {
        put(&server, r#"{"token": "guess"}"#);
    }
    assert_eq!(put(&server, r#"{"token": "guess"}"#).0, 429);
}

/// Team B, with its token and the vehicle's key, cannot replace team A before its take-off.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_team_keeps_its_check_in_until_it_has_flown() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("runs.sqlite");
    let board = Leaderboard::open(&Database::File(file.clone())).await.unwrap();
    let [ants, bees] =
        [board.add_team("ants").await.unwrap(), board.add_team("bees").await.unwrap()];
    let option = format!("--leaderboard={}", file.display());
    let arena = write_arena(folder.path(), "");
    let server = Server::start(&arena, &[&option, "--print-page-keys", "--login=always"]);
    let [instructor, key] = ["instructor", "team of 'vizflyt'"].map(|whose| {
        server.line(|line| {
            let key = &line["page_key"];
            let link = (key["for"] == whose).then(|| key["link"].as_str().unwrap())?;
            Some(format!("vizflyt_key={}", link.split_once("key=").unwrap().1))
        })
    });
    let ask = |from: &str, method: &str, cookie: &str, body: &str| {
        let request = format!("{method} /api/vehicles/vizflyt/team");
        send_json_as(server.http, &request, from, cookie, body)
    };
    let by = |token: &str| format!(r#"{{"token": "{token}", "attempt": "official"}}"#);
    let (one, other) = ("127.0.0.1", "127.0.0.2");

    let (status, text) = ask(other, "PUT", "", &by(&bees));
    assert!(status == 403 && text.contains("on a page with that vehicle's key"), "{text}");
    assert_eq!(ask(one, "PUT", &key, &by(&ants)).0, 200);
    let (status, text) = ask(other, "PUT", &key, &by(&bees));
    assert!(status == 403 && text.contains("ants is checked in and has not flown yet"), "{text}");
    let (status, text) = ask(other, "DELETE", &key, "");
    assert_eq!(status, 403, "{text}");
    assert_eq!(standings_as(&server, &instructor)["vehicles"][0]["team"], "ants");
    // The same team, the same computer, and the instructor can.
    assert_eq!(ask(other, "PUT", &key, &by(&ants)).0, 200);
    assert_eq!(ask(other, "DELETE", &key, "").0, 200);
    assert_eq!(ask(one, "PUT", &key, &by(&ants)).0, 200);
    let (status, text) = ask(other, "POST", &instructor, r#"{"team": "bees"}"#);
    assert_eq!((status, text.as_str()), (200, "bees flies vizflyt next: practice"));
}

#[test]
fn flies_without_a_leaderboard() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes.txt");
    std::fs::write(&notes, "these are my notes and no database, although they are long enough")
        .unwrap();
    let option = format!("--leaderboard={}", notes.display());
    let server = Server::start(&write_arena(folder.path(), ""), &[&option]);
    let (status, answer) = http(server.http, "GET /api/leaderboard HTTP/1.1");
    assert!(status == 404 && answer.contains("no runs are kept here"), "{answer}");
    assert!(std::fs::read_to_string(&notes).unwrap().starts_with("these are my notes"));
}

//! The stop button under attack: a real server, attacked over loopback from a separate address (127.0.0.2). The tests
//! print their measurements; limits of seconds allow for a loaded machine.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::resource::{Resource, getrlimit, setrlimit};
use serde_json::Value;
use tokio::net::{TcpSocket, TcpStream as AsyncStream};
use tokio::runtime::Runtime;
use vizflyt_e2e::{good, vizflyt};
use vizflyt_fixtures::{TEXT, WebSocket};

/// `vizflyt serve` with two vehicles, killed when dropped.
struct Server {
    child: Child,
    _lifeline: ChildStdin,
    http: SocketAddr,
    instructor: String,
    ants: String,
    _folder: tempfile::TempDir,
}

impl Server {
    /// Starts a server; `limits` are the arguments of the shell's `ulimit`, for the number of descriptors.
    fn start(limits: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        good(&["scene", "generate", "race", "-o", &at("race")]);
        let arena = folder.path().join("race/arena.toml");
        let more = "\n[[vehicles]]\nname = \"ant\"\n[[vehicles]]\nname = \"bee\"\n";
        std::fs::write(&arena, std::fs::read_to_string(&arena).unwrap() + more).unwrap();
        let mut child = Command::new("sh")
            .arg("-c")
            .arg(format!("ulimit {limits} && exec \"$0\" \"$@\""))
            .arg(vizflyt())
            .args(["serve", "--json", "--lifeline", "--leaderboard=none", "--print-page-keys"])
            .args(["--login=always", "--quic=127.0.0.1:0", "--http=127.0.0.1:0"])
            .args(["--vicon=127.0.0.1:0", "--renderer=cpu", "--keys", &at("keys")])
            .arg(Path::new(&arena))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lifeline = child.stdin.take().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut line = |key: &str| -> Value {
            let mut found = lines.by_ref().map(|line| line.unwrap());
            let mut parsed =
                found.by_ref().map(|line| serde_json::from_str::<Value>(&line).unwrap());
            parsed.find(|line| line.get(key).is_some()).expect("the server goes on")
        };
        let http = line("ready")["http"].as_str().unwrap().strip_prefix("http://").unwrap().parse();
        let http = http.unwrap();
        let [instructor, ants] = ["instructor", "team of 'ant'"].map(|whose| {
            let key = line("page_key")["page_key"].clone();
            assert_eq!(key["for"], whose);
            let link = key["link"].as_str().unwrap();
            format!("vizflyt_key={}", link.split_once("key=").unwrap().1)
        });
        // Read all further output, so that the pipe does not fill.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, _lifeline: lifeline, http, instructor, ants, _folder: folder }
    }

    /// Presses the instructor's button from this computer, on a new connection; returns the time of the response.
    fn stop(&self) -> Duration {
        let start = Instant::now();
        let mut stream = TcpStream::connect(self.http).expect("the server listens");
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (http, cookie) = (self.http, &self.instructor);
        write!(
            stream,
            "POST /api/estop HTTP/1.1\r\nHost: {http}\r\nOrigin: http://{http}\r\n\
             Cookie: {cookie}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
        )
        .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        // There is no runtime to stop; only an instructor gets this status.
        assert!(answer.starts_with("HTTP/1.1 409"), "{answer:?}");
        start.elapsed()
    }

    /// Presses the button many times, and prints the times.
    fn check_stop(&self, during: &str) {
        let mut took: Vec<_> = (0..PRESSES)
            .map(|_| {
                std::thread::sleep(Duration::from_millis(25));
                self.stop()
            })
            .collect();
        took.sort();
        let ms = |took: Duration| took.as_secs_f64() * 1e3;
        let (half, most) = (ms(took[PRESSES / 2]), ms(took[PRESSES - 1]));
        println!("{during}: the stop button answered within {half:.1} ms, at most {most:.1} ms");
        assert!(took[PRESSES - 1] < PATIENCE, "{took:?}");
    }

    fn watch(&self, path: &str, cookie: &str) -> WebSocket {
        let headers = format!("Origin: http://{}\r\nCookie: {cookie}\r\n", self.http);
        WebSocket::open(self.http, path, &headers).expect("a WebSocket")
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Connects from the attacker's address, which differs from the instructor's.
async fn attack(to: SocketAddr) -> std::io::Result<AsyncStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind("127.0.0.2:0".parse().unwrap())?;
    socket.connect(to).await
}

/// Opens idle connections, up to the limit of this process; returns the established ones.
fn idle_connections(runtime: &Runtime, to: SocketAddr, most: usize) -> Vec<AsyncStream> {
    runtime.block_on(async {
        let mut streams = Vec::new();
        while streams.len() < most {
            let connecting: Vec<_> = (0..200).map(|_| tokio::spawn(attack(to))).collect();
            let mut failed = false;
            for connecting in connecting {
                match connecting.await.unwrap() {
                    Ok(stream) => streams.push(stream),
                    Err(_) => failed = true,
                }
            }
            if failed {
                break;
            }
        }
        streams
    })
}

/// Asserts that a WebSocket still sends messages.
fn check_lives(socket: &mut WebSocket) {
    for _ in 0..40 {
        assert!(socket.receive().0 <= 2, "it was closed");
    }
}

/// Returns the close reason of a WebSocket.
fn reason(socket: &mut WebSocket) -> String {
    loop {
        let (opcode, payload) = socket.receive();
        if opcode == CLOSE {
            return String::from_utf8(payload.get(2..).unwrap_or_default().to_vec()).unwrap();
        }
    }
}

#[test]
fn stop_button_works_under_attack_of_one_address_and_one_team() {
    // Use all available descriptors, except those that the test itself needs.
    let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, hard, hard).unwrap();
    let most = usize::try_from(hard).unwrap_or(usize::MAX).saturating_sub(500).min(10_000);
    // The soft limit of a login shell; the server raises it itself.
    let server = Server::start("-S -n 1024");
    let runtime = Runtime::new().unwrap();
    let mut watching = server.watch("/ws?vehicle=ant", &server.instructor);
    server.check_stop("no attack");

    let idle = idle_connections(&runtime, server.http, most);
    assert!(idle.len() >= most.min(1100), "only {} connections", idle.len());
    server.check_stop(&format!("{} idle connections", idle.len()));
    let go_on = runtime.spawn({
        let http = server.http;
        async move {
            let mut held = std::collections::VecDeque::new();
            loop {
                held.extend(attack(http).await.ok());
                if held.len() > 200 {
                    held.pop_front();
                }
            }
        }
    });
    server.check_stop("connections as fast as they come");
    go_on.abort();
    drop(idle);

    // With a team's key: its first pages stay connected, further ones are closed with a reason.
    let mut team: Vec<_> = (0..64).map(|_| server.watch("/ws?vehicle=ant", &server.ants)).collect();
    server.check_stop("64 WebSockets of a team");
    let told = reason(team.last_mut().unwrap());
    assert!(told.contains("with this team's key already; close one"), "{told:?}");
    check_lives(&mut team[0]);
    let mut late = server.watch("/ws?vehicle=ant", &server.instructor);
    assert_eq!(late.receive().0, TEXT);
    check_lives(&mut late);

    // Bodies that never end, 100 per second.
    let posts = runtime.spawn({
        let http = server.http;
        async move {
            let mut held = Vec::new();
            let mut tick = tokio::time::interval(Duration::from_millis(10));
            loop {
                tick.tick().await;
                let Ok(stream) = attack(http).await else { continue };
                let head = format!(
                    "POST /api/login HTTP/1.1\r\nHost: {http}\r\nOrigin: http://{http}\r\n\
                     Content-Length: 9000\r\n\r\n{{"
                );
                stream.writable().await.unwrap();
                let _ = stream.try_write(head.as_bytes());
                held.push(stream);
            }
        }
    });
    std::thread::sleep(Duration::from_secs(2));
    server.check_stop("100 slow posts per second");
    posts.abort();
    check_lives(&mut watching);
}

/// The process has 64 descriptors, and more connections arrive.
#[test]
fn stop_button_works_with_few_descriptors() {
    let server = Server::start("-n 64");
    let runtime = Runtime::new().unwrap();
    let idle = idle_connections(&runtime, server.http, 400);
    assert_eq!(idle.len(), 400);
    server.check_stop("400 idle connections, 64 descriptors");
}

/// Timeout, far above what a loaded machine needs; a server without free connections would not respond at all.
const PATIENCE: Duration = Duration::from_secs(10);
const PRESSES: usize = 20;
/// Opcode of a close frame (RFC 6455, section 5.2).
const CLOSE: u8 = 8;

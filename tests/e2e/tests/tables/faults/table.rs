//! Table of the faults' effects on the stream, one row per case.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::time::{Instant, sleep_until};
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::clock;
use vizflyt_server::stream::rate_control::Adaptation;
use vizflyt_server::stream::transport::Congestion;

use super::memory;
use super::network::{Impairment, Network};
use super::rig::{Keys, Notes, Runtime, SERVER, Server, Source};
use super::world::{World, lock};

/// A case of the table.
#[derive(Clone)]
pub(crate) struct Case {
    pub(crate) name: String,
    pub(crate) congestion: Congestion,
    /// Address of the runtime.
    host: &'static str,
    /// Impairment of both directions.
    pub(crate) path: Impairment,
    pub(crate) script: Script,
    pub(crate) source: Source,
}

/// Additional fault of a case.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Script {
    /// No additional fault.
    Nothing,
    /// No packet arrives for two seconds.
    Blackout,
    /// The server is killed, and restarts a second later.
    ServerRestart,
    /// The runtime is killed, and restarts half a second later.
    RuntimeRestart,
    /// The runtime changes its address.
    Move,
}

/// A row of the table.
pub(crate) struct Row {
    pub(crate) name: String,
    /// Fraction of the images rendered by a running server that arrived. [%]
    pub(crate) delivered: f64,
    /// Image age from rendering to reception, p50 and p99. [ms]
    pub(crate) age_ms: [f64; 2],
    /// Time from the end of the fault to the arrival of an image rendered after it. [ms]
    pub(crate) newest_ms: Option<f64>,
    /// Age of poses. [ms]
    pub(crate) pose_ms_p99: f64,
    /// Longest time without an image. [ms]
    pub(crate) gap_ms: f64,
    pub(crate) events: u32,
    pub(crate) lost: u32,
    pub(crate) doubled: u32,
    /// Images that arrived after a newer one.
    pub(crate) backwards: u32,
}

/// Virtual duration of a case.
pub(crate) const LASTS: Duration = Duration::from_secs(14);
/// Start of the fault.
const FAULT: Duration = Duration::from_secs(5);

impl Case {
    /// Runs the case.
    pub(crate) fn play(&self) -> Row {
        let notes = Arc::new(Mutex::new(Notes::default()));
        let noted = notes.clone();
        let fault = World::run(|world| self.act(world, noted));
        let notes = Arc::into_inner(notes).expect("all tasks are gone").into_inner().unwrap();
        self.row(notes, fault)
    }

    /// Runs the scenario; returns start and end of the fault on the server's clock.
    async fn act(&self, world: Arc<World>, notes: Arc<Mutex<Notes>>) -> [ServerTime; 2] {
        let start = Instant::now();
        let stamp = clock::now();
        let mut path = self.path.clone();
        let back = FAULT
            + match self.script {
                Script::Nothing | Script::Move => Duration::ZERO,
                Script::Blackout => Duration::from_secs(2),
                Script::ServerRestart => Duration::from_secs(1),
                Script::RuntimeRestart => Duration::from_millis(500),
            };
        if self.script == Script::Blackout {
            path.blackouts.push(FAULT..back);
        }
        let network = Network::new(world, 7, SERVER.parse().unwrap(), path.clone(), path);
        let keys = Keys::make();
        let serve = || Server::start(&network, &keys, self.congestion, &self.source, &notes);
        let fly = |address: &str| Runtime::start(&network, &keys, address.parse().unwrap(), &notes);
        let mut server = serve();
        let mut runtime = fly(&format!("{}:5000", self.host));
        sleep_until(start + FAULT).await;
        match self.script {
            Script::Nothing | Script::Blackout => {}
            Script::Move => runtime.move_to("10.0.0.3:6000".parse().unwrap()),
            Script::ServerRestart => server.kill(&notes),
            Script::RuntimeRestart => runtime.kill(),
        }
        sleep_until(start + back).await;
        match self.script {
            Script::ServerRestart => server = serve(),
            Script::RuntimeRestart => runtime = fly(&format!("{}:5100", self.host)),
            Script::Nothing | Script::Blackout | Script::Move => {}
        }
        sleep_until(start + LASTS).await;
        server.note_events(&notes);
        drop(runtime);
        [stamp.plus_seconds(FAULT.as_secs_f64()), stamp.plus_seconds(back.as_secs_f64())]
    }

    fn row(&self, notes: Notes, [_, back]: [ServerTime; 2]) -> Row {
        let mut ages: Vec<f64> = notes
            .images
            .iter()
            .map(|(rendered, came)| came.seconds_since(*rendered) * 1e3)
            .collect();
        ages.sort_unstable_by(f64::total_cmp);
        let mut poses = notes.poses_s;
        poses.sort_unstable_by(f64::total_cmp);
        let at = |values: &[f64], share: f64| {
            let index = (share * values.len() as f64) as usize;
            values.get(index.min(values.len().saturating_sub(1))).copied().unwrap_or(f64::NAN)
        };
        let newest = notes.images.iter().find(|(rendered, _)| *rendered >= back);
        let gaps = notes.images.windows(2).map(|pair| pair[1].1.seconds_since(pair[0].1) * 1e3);
        // The newest events may still be in transit at the end.
        let events = |sent: u32| sent.saturating_sub(2);
        let (down, up) = (&notes.events_down, &notes.events_up);
        let came = |n: &u32| down.iter().any(|process| process.contains_key(n));
        let lost = (0..events(notes.told_down)).filter(|n| !came(n)).count()
            + (0..events(notes.told_up)).filter(|n| !up.contains_key(n)).count();
        let counts = down.iter().chain([up]).flat_map(BTreeMap::values);
        let doubled = counts.filter(|&&count| count > 1).count();
        Row {
            name: self.name.clone(),
            delivered: 100.0 * notes.images.len() as f64 / notes.rendered.len() as f64,
            age_ms: [at(&ages, 0.5), at(&ages, 0.99)],
            newest_ms: (self.script != Script::Nothing)
                .then(|| newest.map_or(f64::NAN, |(_, came)| came.seconds_since(back) * 1e3)),
            pose_ms_p99: at(&poses, 0.99) * 1e3,
            gap_ms: gaps.fold(0.0, f64::max),
            events: notes.told_down + notes.told_up,
            lost: lost as u32,
            doubled: doubled as u32,
            backwards: notes.images.windows(2).filter(|pair| pair[1].0 <= pair[0].0).count() as u32,
        }
    }
}

/// Formats the table.
pub(crate) fn text(rows: &[Row]) -> String {
    let mut out = format!(
        "{:<36}{:>10}{:>9}{:>9}{:>9}{:>9}{:>10}{:>7}\n{:<36}{:>10}{:>9}{:>9}{:>9}{:>9}{:>10}{:>7}\n",
        "case",
        "delivered",
        "age p50",
        "age p99",
        "pose p99",
        "gap",
        "recovery",
        "events",
        "",
        "%",
        "ms",
        "ms",
        "ms",
        "ms",
        "ms",
        "lost",
    );
    for row in rows {
        let ms = |ms: f64| if ms.is_finite() { format!("{ms:.1}") } else { "-".to_owned() };
        let recovery = row.newest_ms.map_or("-".to_owned(), ms);
        writeln!(
            out,
            "{:<36}{:>10.1}{:>9}{:>9}{:>9}{:>9}{:>10}{:>7}",
            row.name,
            row.delivered,
            ms(row.age_ms[0]),
            ms(row.age_ms[1]),
            ms(row.pose_ms_p99),
            ms(row.gap_ms),
            recovery,
            row.lost,
        )
        .unwrap();
    }
    out
}

/// Returns significant differences from the committed table.
///
/// Cases without loss are identical in every run. With loss, tokio's `select!` chooses randomly between two ready
/// branches, which changes the lost packets.
pub(crate) fn differences(found: &str, committed: &str) -> Vec<String> {
    let mut differences = Vec::new();
    if found.lines().count() != committed.lines().count() {
        differences.push("not as many cases".to_owned());
    }
    for (found, expected) in found.lines().zip(committed.lines()).skip(2) {
        let split = |line: &str| {
            let (name, figures) = line.split_at(NAME_WIDTH);
            let figures: Vec<Option<f64>> =
                figures.split_whitespace().map(|figure| figure.parse().ok()).collect();
            (name.trim().to_owned(), figures)
        };
        let ((name, found_figures), (expected_name, expected_figures)) =
            (split(found), split(expected));
        let near = |index: usize, found: Option<f64>, expected: Option<f64>| match (found, expected)
        {
            (Some(found), Some(expected)) => {
                let allowed = match index {
                    0 => 4.0,
                    6 => 0.0,
                    // A gap is the maximum of a thousand values.
                    4 => 10.0 + 0.5 * expected,
                    _ => 3.0 + 0.25 * expected,
                };
                (found - expected).abs() <= allowed
            }
            (found, expected) => found == expected,
        };
        let figures = found_figures.iter().zip(&expected_figures).enumerate();
        let alike = found_figures.len() == expected_figures.len()
            && figures.into_iter().all(|(at, (found, expected))| near(at, *found, *expected));
        if name != expected_name || !alike {
            differences.push(format!("found    {found}\ncommitted {expected}"));
        }
    }
    differences
}

const NAME_WIDTH: usize = 36;

/// Streams small images over a cable; returns the allocated bytes after each of `times` spans.
pub(crate) fn soak(span: Duration, times: u32) -> Vec<usize> {
    World::run(|world| async move {
        let notes = Arc::new(Mutex::new(Notes::default()));
        let (keys, source, cable) = (Keys::make(), Source::small(), Impairment::default());
        let server = SERVER.parse().unwrap();
        let network = Network::new(world, 7, server, cable.clone(), cable);
        let _server = Server::start(&network, &keys, Congestion::Lan, &source, &notes);
        let address = "10.0.0.2:5000".parse().unwrap();
        let _runtime = Runtime::start(&network, &keys, address, &notes);
        let mut live = Vec::new();
        for _ in 0..times {
            tokio::time::sleep(span).await;
            let mut notes = lock(&notes);
            let due = span.as_secs() as usize * source.rate_hz as usize;
            assert!(notes.images.len() > due * 99 / 100, "{} of {due}", notes.images.len());
            // Reset the test's own records, so that they do not count.
            let down = notes.events_down.len();
            *notes = Notes { events_down: vec![BTreeMap::new(); down], ..Notes::default() };
            live.push(memory::live().max(0) as usize);
        }
        live
    })
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// A private address, and a public one (TEST-NET-3, RFC 5737).
const NEAR: &str = "10.0.0.2";
const PUBLIC: &str = "203.0.113.2";

/// Returns all cases.
pub(crate) fn cases() -> Vec<Case> {
    use Congestion::{Auto, Bbr, Lan};
    let near = || Impairment { delay: ms(1), ..Impairment::default() };
    let source = Source::vga();
    let mut all = Vec::new();
    let mut add = |name: &str, congestion, path: Impairment, script| {
        let name = format!("{name}, {}", format!("{congestion:?}").to_lowercase());
        let host = if congestion == Auto { PUBLIC } else { NEAR };
        all.push(Case { name, congestion, host, path, script, source: source.clone() });
    };
    add("cable", Lan, Impairment::default(), Script::Nothing);
    for loss in [0, 1, 5, 10, 20] {
        for congestion in [Lan, Bbr] {
            let path = Impairment { loss: f64::from(loss) / 100.0, ..near() };
            add(&format!("1 ms, {loss} % lost"), congestion, path, Script::Nothing);
        }
    }
    for delay in [5, 20, 50] {
        let path = Impairment { delay: ms(delay), ..near() };
        add(&format!("{delay} ms"), Lan, path, Script::Nothing);
    }
    for congestion in [Lan, Bbr, Auto] {
        let path = Impairment { delay: ms(20), loss: 0.01, ..near() };
        let what = if congestion == Auto { "20 ms, 1 % lost, public" } else { "20 ms, 1 % lost" };
        add(what, congestion, path, Script::Nothing);
    }
    let path = Impairment { delay: ms(5), jitter: ms(10), ..near() };
    add("5 ms, jitter 10 ms", Lan, path, Script::Nothing);
    let path = Impairment { delay: ms(1), jitter: ms(50), ..near() };
    add("1 ms, jitter 50 ms", Lan, path, Script::Nothing);
    add("10 % reordered", Lan, Impairment { reorder: 0.1, ..near() }, Script::Nothing);
    add("10 % twice", Lan, Impairment { duplicate: 0.1, ..near() }, Script::Nothing);
    let path = Impairment {
        delay: ms(10),
        jitter: ms(5),
        loss: 0.02,
        duplicate: 0.02,
        reorder: 0.02,
        ..near()
    };
    for congestion in [Lan, Bbr] {
        add("10 ms, all at once", congestion, path.clone(), Script::Nothing);
    }
    for mtu in [1228, 1500, 9000] {
        add(&format!("MTU {mtu}"), Lan, Impairment { mtu, ..near() }, Script::Nothing);
    }
    for congestion in [Lan, Bbr] {
        add("blackout 2 s", congestion, near(), Script::Blackout);
    }
    add("server restarts in 1 s", Lan, near(), Script::ServerRestart);
    add("runtime restarts in 0.5 s", Lan, near(), Script::RuntimeRestart);
    add("runtime changes its address", Lan, near(), Script::Move);
    for mbit in [100, 20] {
        for congestion in [Lan, Bbr] {
            let bandwidth_bps = mbit * 1_000_000;
            let path = Impairment { bandwidth_bps, queue: 256 << 10, ..near() };
            add(&format!("{mbit} Mbit/s"), congestion, path, Script::Nothing);
        }
    }
    for (mbit, adapt, what) in [
        (50, Adaptation::None, "50 Mbit/s, as is"),
        (50, Adaptation::Quality, "50 Mbit/s, lower quality"),
        (20, Adaptation::Quality, "20 Mbit/s, lower quality"),
        (20, Adaptation::All, "20 Mbit/s, lower all"),
        (5, Adaptation::All, "5 Mbit/s, lower all"),
    ] {
        let path = Impairment { bandwidth_bps: mbit * 1_000_000, queue: 256 << 10, ..near() };
        let source = Source { adapt, ..source.clone() };
        let (name, script) = (format!("{what}, lan"), Script::Nothing);
        all.push(Case { name, congestion: Lan, host: NEAR, path, script, source });
    }
    all
}

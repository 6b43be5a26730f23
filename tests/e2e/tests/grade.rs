//! `vizflyt grade` as an instructor uses it: reproducible hashes, signatures, shards, reports, and failing plugins.

use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use tempfile::TempDir;
use vizflyt_e2e::{root, vizflyt};

/// An instructor's temporary folder with keys and files.
struct Rig {
    folder: TempDir,
}

impl Rig {
    fn new() -> Self {
        use std::os::unix::fs::PermissionsExt;
        let rig = Self { folder: tempfile::tempdir().unwrap() };
        for keys in ["keys", "others"] {
            fs::create_dir(rig.at(keys)).unwrap();
            fs::set_permissions(rig.at(keys), fs::Permissions::from_mode(0o700)).unwrap();
        }
        rig
    }

    fn at(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn run(&self, args: &[&str]) -> Output {
        let keys = format!("--keys={}", self.at("keys"));
        Command::new(vizflyt()).arg("grade").args(args).arg(keys).output().unwrap()
    }

    fn good(&self, args: &[&str]) -> String {
        let output = self.run(args);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{args:?}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    }

    fn refused(&self, args: &[&str], text: &str) {
        let output = self.run(args);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success(), "{args:?} succeeded");
        assert!(message.contains(text) && !message.contains("panicked"), "{args:?}: {message}");
    }

    fn grade(&self, args: &[&str]) -> Value {
        serde_json::from_str(&self.good(args)).unwrap()
    }
}

const FOREST: [&str; 5] = ["avoid", "--project=forest", "--seeds=2", "--image-rate=15", "--json"];

/// A slow server on the virtual clock: ten images per second, each 200 ms old at arrival, and 50 ms for the reply.
#[test]
fn example_avoids_all_obstacles_with_late_and_rare_images() {
    let rig = Rig::new();
    let starved = ["--image-rate=10", "--image-delay=200", "--answer-delay=50", "--seeds=4"];
    let args = [&["avoid", "--project=forest", "--json"], &starved[..]].concat();
    let grade = rig.grade(&args);
    for run in grade["runs"].as_array().unwrap() {
        assert_eq!(run["outcome"], "finished", "{run}");
        assert!(run["min_clearance_m"].as_f64().unwrap() > 0.1, "{run}");
    }
}

fn with<'a>(more: &[&'a str]) -> Vec<&'a str> {
    FOREST.iter().copied().chain(more.iter().copied()).collect()
}

#[test]
fn merged_shards_equal_the_complete_grade() {
    let rig = Rig::new();
    let one = rig.grade(&with(&["--jobs=2"]));
    assert_eq!(one["hash"].as_str().unwrap().len(), 64);
    let runs = one["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 2);
    for (run, seed) in runs.iter().zip([1, 2]) {
        assert_eq!(run["seed"], seed);
        assert_eq!(run["outcome"], "finished", "{run}");
        assert!(run["stages_passed"].is_u64(), "{run}");
        assert!((5.0..60.0).contains(&run["seconds"].as_f64().unwrap()), "{run}");
        assert!(run["min_clearance_m"].as_f64().unwrap() > 0.0, "{run}");
    }
    assert_ne!(runs[0]["hash"], runs[1]["hash"]);

    // Again in two shards, one flight at a time: figures, hashes and signature are the same.
    let parts = ["1/2", "2/2"].map(|shard| {
        let file = rig.at(&format!("part-{}.json", &shard[..1]));
        let part = rig.grade(&with(&[&format!("--shard={shard}"), "--jobs=1", "-o", &file]));
        assert_eq!(part["runs"].as_array().unwrap().len(), 1);
        file
    });
    rig.refused(&["merge", &parts[0]], "missing parts of 2: 2");
    let whole = rig.at("whole.json");
    let report = rig.at("merged");
    rig.good(&["merge", &parts[1], &parts[0], "-o", &whole, "--report", &report]);
    let page = fs::read_to_string(Path::new(&report).join("index.html")).unwrap();
    assert!(page.contains("2 of 2") && page.contains("report of the part that flew it"), "{page}");
    rig.good(&["verify", Path::new(&report).join("grade.json").to_str().unwrap()]);
    rig.good(&["verify", &report]);
    let mut merged: Value = serde_json::from_str(&fs::read_to_string(&whole).unwrap()).unwrap();
    for field in ["hash", "subject", "summary", "runs"] {
        assert_eq!(merged[field], one[field]);
    }
    // Equal except for the report's files.
    assert!(merged.as_object_mut().unwrap().remove("files").is_some());
    assert_eq!(merged.as_object().unwrap().len(), one.as_object().unwrap().len());

    // The signature is valid, but not after a change, and not for another key.
    rig.good(&["verify", &whole]);
    let public = rig.good(&["key"]);
    rig.good(&["verify", &whole, "--key", public.trim()]);
    let keys = format!("--keys={}", rig.at("others"));
    let other = Command::new(vizflyt()).args(["grade", "key", &keys]).output().unwrap();
    let other = String::from_utf8(other.stdout).unwrap();
    rig.refused(&["verify", &whole, "--key", other.trim()], "is signed with the key");
    on_the_leaderboard(&rig, &whole, &parts[0]);
    let text = fs::read_to_string(&whole).unwrap();
    let forged = text.replacen("\"seed\": 2", "\"seed\": 3", 1);
    assert_ne!(forged, text);
    fs::write(&whole, forged).unwrap();
    rig.refused(&["verify", &whole], "was changed after it was signed");
    let error = leaderboard(&rig, &["add", &whole, "--team=wasps", &keys_of(&rig)]).unwrap_err();
    assert!(error.contains("was changed after it was signed"), "{error}");
}

#[test]
fn grade_names_the_inertial_sensor_and_depends_on_it() {
    let rig = Rig::new();
    let flown = |more: &[&str]| {
        let one = ["avoid", "--project=forest", "--seeds=1", "--image-rate=15", "--json"];
        rig.grade(&[&one[..], more].concat())
    };
    let (usual, named, chip) = (flown(&[]), flown(&["--imu=frame"]), flown(&["--imu=icm-42688-p"]));
    assert_eq!(usual["hash"], named["hash"]);
    assert_eq!(usual["subject"].get("imu"), None);
    assert_eq!(chip["subject"]["imu"], "icm-42688-p");
    assert_eq!(chip["runs"][0]["outcome"], "finished", "{}", chip["runs"][0]);
    assert_ne!(chip["runs"][0]["hash"], usual["runs"][0]["hash"]);
}

/// A machine that is suspended, swapping or overloaded must not cost points: in lock-step, a plugin detects the end of
/// its runtime by the socket, not by a clock.
#[test]
fn grader_stopped_for_seconds_gives_the_same_grade() {
    let rig = Rig::new();
    let args = ["avoid", "--project=forest", "--seeds=1", "--image-rate=15", "--json"];
    let hash = rig.grade(&args)["hash"].clone();
    let keys = format!("--keys={}", rig.at("keys"));
    let mut command = Command::new(vizflyt());
    command.arg("grade").args(args).arg(keys).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut grader = command.spawn().unwrap();
    let id = Pid::from_raw(grader.id().cast_signed());
    let done = AtomicBool::new(false);
    let mut output = String::new();
    let stops = std::thread::scope(|scope| {
        let stopper = scope.spawn(|| {
            let mut stops = 0;
            while !done.load(Ordering::Relaxed) && stops < 3 {
                std::thread::sleep(Duration::from_millis(1500));
                if kill(id, Signal::SIGSTOP).is_ok() {
                    std::thread::sleep(Duration::from_millis(3200));
                    kill(id, Signal::SIGCONT).unwrap();
                    stops += 1;
                }
            }
            stops
        });
        // The process has not been waited for yet, so its pid is not reused.
        grader.stdout.take().unwrap().read_to_string(&mut output).unwrap();
        done.store(true, Ordering::Relaxed);
        stopper.join().unwrap()
    });
    assert!(grader.wait().unwrap().success() && stops > 0, "{stops} stops: {output}");
    let graded: Value = serde_json::from_str(&output).unwrap();
    assert_eq!(graded["hash"], hash, "{graded:#}");
}

/// Starts a grader in the background.
fn start(rig: &Rig, args: &[&str]) -> Child {
    let keys = format!("--keys={}", rig.at("keys"));
    let mut command = Command::new(vizflyt());
    command.arg("grade").args(args).arg(keys).stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

/// Waits for the grader's built-in plugin: a process whose first argument is `plugin`, started by the grader or by the
/// process of the plugin's cell.
fn plugin_of(grader: &Child) -> Pid {
    let (grader, is_plugin) = (grader.id(), |id: u32| {
        let line = fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
        line.split(|&byte| byte == 0).nth(1) == Some(b"plugin")
    });
    let parent = |id: u32| -> Option<u32> {
        let stat = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
        stat.rsplit_once(") ")?.1.split(' ').nth(1)?.parse().ok()
    };
    let is_of_grader =
        |id: u32| std::iter::successors(Some(id), |&id| parent(id)).take(8).any(|id| id == grader);
    loop {
        let entries = fs::read_dir("/proc").unwrap().flatten();
        let mut ids = entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
        if let Some(id) = ids.find(|&id| is_plugin(id) && is_of_grader(id)) {
            return Pid::from_raw(id.cast_signed());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A plugin's time limit counts its own processor time, not wall-clock time: a plugin stopped by another process for
/// longer than the limit has the same grade.
#[test]
fn plugin_stopped_for_seconds_gives_the_same_grade() {
    let rig = Rig::new();
    let args = ["avoid", "--project=forest", "--seeds=1", "--image-rate=15", "--json"];
    let hash = rig.grade(&args)["hash"].clone();
    let within = [&args[..], &["--answer-within=1"]].concat();
    let grader = start(&rig, &within);
    let plugin = plugin_of(&grader);
    // At the start, and at any later time; once together with the grader, which continues first.
    let id = Pid::from_raw(grader.id().cast_signed());
    for (after_ms, also) in [(30, None), (700, None), (900, Some(id))] {
        std::thread::sleep(Duration::from_millis(after_ms));
        if kill(plugin, Signal::SIGSTOP).is_err() {
            break;
        }
        also.map(|also| kill(also, Signal::SIGSTOP));
        std::thread::sleep(Duration::from_millis(2300));
        also.map(|also| kill(also, Signal::SIGCONT));
        std::thread::sleep(Duration::from_millis(100));
        kill(plugin, Signal::SIGCONT).unwrap();
    }
    let output = grader.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let graded: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(graded["hash"], hash, "{graded:#}");
}

/// A plugin killed by another process is not graded: the flight is repeated, and without success nothing is graded.
#[test]
fn lost_flights_are_repeated_and_never_graded() {
    let rig = Rig::new();
    let args = ["avoid", "--project=forest", "--seeds=1", "--image-rate=15", "--json"];
    let hash = rig.grade(&args)["hash"].clone();
    let grader = start(&rig, &args);
    let plugin = plugin_of(&grader);
    std::thread::sleep(Duration::from_millis(600));
    kill(plugin, Signal::SIGKILL).unwrap();
    let output = grader.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && errors.contains("flown again (1 of 2)"), "{errors}");
    let graded: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(graded["hash"], hash, "{graded:#}");
    let always = script(&rig, "always", "kill -9 $$");
    rig.refused(&[&always, "--project=forest", "--seeds=1"], "not flown to its end in 3 attempts");
}

/// A plugin that behaves randomly and kills itself after a bad start is detected by the difference of its flights.
#[test]
fn plugin_that_kills_itself_to_retry_is_rejected() {
    let rig = Rig::new();
    let program = vizflyt().with_file_name("examples/misbehave");
    fs::copy(&program, rig.at("misbehave")).unwrap();
    let lots = script(&rig, "lots", "exec \"$(dirname \"$0\")/misbehave\" lots \"$@\"");
    let args = [&lots, "--project=forest", "--seeds=1", "--image-rate=10"];
    rig.refused(&args, "differs before the point where the first one was lost");
}

/// Without sandbox cells, a grade is not signed.
#[test]
fn does_not_sign_without_namespaces() {
    let rig = Rig::new();
    // Root without the capability to create namespaces; other users have other restrictions.
    let is_root = nix::unistd::geteuid().is_root();
    let drop = ["--bounding-set=-sys_admin", "--inh-caps=-sys_admin"];
    let can_drop = is_root
        && Command::new("setpriv").args(drop).arg("true").status().is_ok_and(|it| it.success());
    if !can_drop {
        return println!("skipped: no root, or no setpriv");
    }
    let keys = format!("--keys={}", rig.at("keys"));
    let mut command = Command::new("setpriv");
    command.args(drop).arg(vizflyt());
    command.args(["grade", "avoid", "--project=forest", "--seeds=1", "--image-rate=10", "--json"]);
    let output = command.arg(&keys).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("this grade is NOT signed: a plugin here could"), "{errors}");
    let grade: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&grade["signature"], &grade["summary"]["runs"]), (&Value::Null, &1.into()));
    let file = rig.at("unsigned.json");
    fs::write(&file, &output.stdout).unwrap();
    rig.refused(&["verify", &file], "the grade is not signed");
}

#[test]
fn reads_the_seed_from_a_file() {
    let rig = Rig::new();
    let file = rig.at("seed");
    fs::write(&file, "4\n").unwrap();
    let args = ["avoid", "--project=forest", "--seeds=1", "--image-rate=5", "--json"];
    let typed = rig.grade(&[&args[..], &["--first-seed=4"]].concat());
    let read = rig.grade(&[&args[..], &[&format!("--first-seed=@{file}")]].concat());
    assert_eq!((&read["hash"], &read["subject"]["first_seed"]), (&typed["hash"], &4.into()));
    fs::write(&file, "a secret\n").unwrap();
    let output = rig.run(&[&args[..], &[&format!("--first-seed=@{file}")]].concat());
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("holds no seed") && !errors.contains("a secret"), "{errors}");
}

/// Keeps the processors busy until it is dropped.
struct Load(Vec<Child>);

impl Load {
    fn new() -> Self {
        let busy = || Command::new("sh").args(["-c", "while :; do :; done"]).spawn().unwrap();
        Self((0..4).map(|_| busy()).collect())
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        for busy in &mut self.0 {
            let _ = busy.kill();
            let _ = busy.wait();
        }
    }
}

#[test]
fn hash_does_not_depend_on_jobs_load_or_resuming() {
    let rig = Rig::new();
    let args = ["avoid", "--project=forest", "--seeds=3", "--image-rate=10", "--json"];
    let loaded = {
        let _load = Load::new();
        rig.grade(&[&args[..], &["--jobs=8"]].concat())
    };
    let report = rig.at("report");
    let one = [&args[..], &["--jobs=1", "--report", &report]].concat();
    let mut grader = start(&rig, &one);
    // The order of the flights is not defined.
    let record = |seed: u32| Path::new(&report).join(format!("flights/day-{seed}.json"));
    let seed = loop {
        match (1..=3).find(|&seed| record(seed).exists()) {
            Some(seed) => break seed,
            None => assert!(grader.try_wait().unwrap().is_none(), "it has ended already"),
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let record = record(seed);
    grader.kill().unwrap();
    grader.wait().unwrap();
    let kept = fs::read_to_string(&record).unwrap();

    // Existing results are not overwritten, and only the same grade can be resumed.
    rig.refused(&one, "keep them with --resume");
    let resumed = [&one[..], &["--resume"]].concat();
    let other = |args: &[&str], word: &str| {
        rig.refused(&[&resumed[..], args].concat(), &format!("with another {word}"));
    };
    other(&["--answer-delay=11"], "time model");
    other(&["--log=full"], "--log");
    other(&["--imu=bmi088"], "--imu");
    rig.refused(&[&["race"], &resumed[1..]].concat(), "with another plugin");
    let p4: Vec<&str> = resumed
        .iter()
        .map(|arg| if arg.contains("forest") { "--project=p4" } else { arg })
        .collect();
    rig.refused(&p4, "with another project");
    fs::write(&record, kept.replacen("\"score\": ", "\"score\": 1", 1)).unwrap();
    rig.refused(&resumed, "was changed after it was written");
    fs::write(&record, &kept).unwrap();
    let log_name = format!("logs/day-{seed}.mcap");
    let log = Path::new(&report).join(&log_name);
    let logged = fs::read(&log).unwrap();
    fs::write(&log, "other").unwrap();
    rig.refused(&resumed, &format!("changed after it was written: {log_name}"));
    fs::write(&log, logged).unwrap();

    let output = rig.run(&resumed);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("of 3 flights are finished already and kept"), "{errors}");
    let grade: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&grade["hash"], &grade["runs"]), (&loaded["hash"], &loaded["runs"]));
    assert_eq!(fs::read_to_string(&record).unwrap(), kept, "it was not flown again");
    rig.good(&["verify", &report]);
    // Resume again: all flights are finished.
    assert_eq!(rig.grade(&resumed)["hash"], loaded["hash"]);
    rig.good(&["verify", &report]);
}

#[test]
fn all_files_of_a_report_are_signed_and_its_logs_can_be_replayed() {
    let rig = Rig::new();
    let (report, junit) = (rig.at("report"), rig.at("grade.xml"));
    let args = ["avoid", "--project=forest", "--seeds=1", "--image-rate=10", "--log=full"];
    let outputs = ["--report", &report, "--junit", &junit];
    rig.good(&[&args[..], &outputs].concat());
    let at = |path: &str| Path::new(&report).join(path);
    let printed = rig.good(&["verify", &report, "--junit", &junit]);
    assert!(printed.contains("files are as signed"), "{printed}");

    // The page shows the images of a finished flight.
    let page = fs::read_to_string(at("index.html")).unwrap();
    for part in ["Flights that finished", "images/day-1-00.jpg", "logs/day-1.mcap", "<svg"] {
        assert!(page.contains(part), "no {part}: {page}");
    }
    let images = fs::read_dir(at("images")).unwrap().count();
    assert!((9..=17).contains(&images), "{images}");

    // Each changed, missing or added file is named.
    for path in
        ["index.html", "junit.xml", "images/day-1-03.jpg", "logs/day-1.mcap", "flights/day-1.json"]
    {
        let bytes = fs::read(at(path)).unwrap();
        let mut changed = bytes.clone();
        let middle = changed.len() / 2;
        changed[middle] ^= 1;
        fs::write(at(path), changed).unwrap();
        rig.refused(&["verify", &report], &format!("changed: {path}"));
        fs::remove_file(at(path)).unwrap();
        rig.refused(&["verify", &report], &format!("missing: {path}"));
        fs::write(at(path), bytes).unwrap();
    }
    fs::write(at("images/day-1-99.jpg"), "").unwrap();
    rig.refused(&["verify", &report], "added: images/day-1-99.jpg");
    fs::remove_file(at("images/day-1-99.jpg")).unwrap();
    rig.good(&["verify", &report]);
    fs::write(&junit, fs::read_to_string(&junit).unwrap().replace("errors=\"0\"", "errors=\"1\""))
        .unwrap();
    rig.refused(&["verify", &report, "--junit", &junit], "is not the JUnit XML of this grade");
    // The document itself remains valid, at any path.
    let printed = rig.good(&["verify", at("grade.json").to_str().unwrap()]);
    assert!(printed.contains("were not checked"), "{printed}");

    // In a replay of the log, a new process of the plugin gives the same replies.
    let log = at("logs/day-1.mcap");
    let answers = rig.at("answers.jsonl");
    let output = Command::new(vizflyt())
        .args(["replay", log.to_str().unwrap(), "--answers", &answers])
        .output()
        .unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(
        output.status.success() && printed.contains("are those of the flight, bit by bit"),
        "{printed} {}",
        String::from_utf8_lossy(&output.stderr)
    );

    // Again, without logs: the same flight, and the earlier report is replaced.
    let hash = |report: &str| {
        let text = fs::read_to_string(Path::new(report).join("grade.json")).unwrap();
        serde_json::from_str::<Value>(&text).unwrap()["hash"].clone()
    };
    let first = hash(&report);
    rig.good(&[&args[..4], &["--log=none", "--report", &report]].concat());
    rig.good(&["verify", &report]);
    assert!(hash(&report) == first && !at("logs/day-1.mcap").exists());
    // All files of a report are signed, so other files are rejected.
    fs::write(at("notes.txt"), "").unwrap();
    rig.refused(&[&args[..4], &["--report", &report]].concat(), "notes.txt");
    fs::remove_file(at("notes.txt")).unwrap();
    let inside = at("me.json");
    let output = ["--report", &report, "-o", inside.to_str().unwrap()];
    rig.refused(&[&args[..4], &output].concat(), "give another folder");
}

fn keys_of(rig: &Rig) -> String {
    format!("--keys={}", rig.at("keys"))
}

/// Runs `vizflyt leaderboard` on the rig's database; returns its output, or its error.
fn leaderboard(rig: &Rig, args: &[&str]) -> Result<String, String> {
    let database = format!("--database={}", rig.at("board.sqlite"));
    let output = Command::new(vizflyt()).args(["leaderboard", &database]).args(args).output();
    let output = output.unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    if output.status.success() { Ok(text(output.stdout)) } else { Err(text(output.stderr)) }
}

/// A complete grade is added once, for the team that the instructor names.
fn on_the_leaderboard(rig: &Rig, whole: &str, part: &str) {
    let keys = keys_of(rig);
    let add = |file: &str, team: &str| leaderboard(rig, &["add", file, team, &keys]);
    let refused = |file: &str, team: &str, expected: &str| {
        let error = add(file, team).unwrap_err();
        assert!(error.contains(expected) && !error.contains("panicked"), "{error}");
    };
    refused(whole, "--team=wasps", "there is no team 'wasps'");
    for team in ["wasps", "bees"] {
        leaderboard(rig, &["team", "add", team]).unwrap();
    }
    refused(
        part,
        "--team=wasps",
        "part 1 of 2 of a grade; combine all parts with `vizflyt grade merge`",
    );
    let others = format!("--keys={}", rig.at("others"));
    let error = leaderboard(rig, &["add", whole, "--team=wasps", &others]).unwrap_err();
    assert!(error.contains("is signed with the key"), "{error}");
    let printed = add(whole, "--team=wasps").unwrap();
    assert!(
        printed.starts_with("added grade ")
            && printed.contains("of team 'wasps'")
            && printed.contains("2 of 2   finished"),
        "{printed}"
    );
    refused(whole, "--team=wasps", "already: team 'wasps' has added it");
    refused(whole, "--team=bees", "already: team 'wasps' has added it");
    let shown: Value =
        serde_json::from_str(&leaderboard(rig, &["show", "--json"]).unwrap()).unwrap();
    let board = &shown["graded"][0];
    assert_eq!((&board["project"], &board["level"]), (&"forest".into(), &"ug".into()));
    assert!(board["conditions"].as_str().unwrap().starts_with("day, seeds 1 to 2, "), "{board}");
    let place = &board["places"][0];
    assert_eq!(
        (&place["rank"], &place["team"], &place["finished"]),
        (&1.into(), &"wasps".into(), &2.into())
    );
    assert!(place["median_s"].as_f64().unwrap() > 5.0, "{place}");
    // A team's stored data can be exported, including the signed grade, and erased.
    let kept: Value =
        serde_json::from_str(&leaderboard(rig, &["team", "export", "wasps"]).unwrap()).unwrap();
    let exported = rig.at("exported.json");
    fs::write(&exported, kept["grades"][0]["document"].as_str().unwrap()).unwrap();
    let verified = Command::new(vizflyt()).args(["grade", "verify", &exported, &keys]).status();
    assert!(verified.unwrap().success(), "{kept}");
    let asked = leaderboard(rig, &["team", "erase", "wasps"]).unwrap();
    assert!(asked.contains("0 runs and 1 grades") && asked.contains("--yes"), "{asked}");
    let term = rig.at("term.zip");
    assert!(leaderboard(rig, &["archive", &term]).unwrap().starts_with("2 teams and 0 runs"));
    leaderboard(rig, &["team", "erase", "wasps", "--yes"]).unwrap();
    let teams = leaderboard(rig, &["team", "list"]).unwrap();
    assert_eq!(teams.trim(), "bees");
}

#[test]
fn race_plugin_flies_with_depth_images_and_fails_without() {
    let rig = Rig::new();
    let race = ["race", "--project=p5", "--seeds=1", "--json"];
    let grade = rig.grade(&race);
    let run = &grade["runs"][0];
    assert_eq!(run["outcome"], "finished", "{run}");
    assert_eq!(run["stages_passed"], 4, "{run}");
    // Colour only: the plugin fails before take-off with the reason.
    let grade = rig.grade(&[&race[..], &["--level=g"]].concat());
    let run = &grade["runs"][0];
    assert_eq!(run["outcome"], "plugin_failed", "{run}");
    let cause = run["cause"].as_str().unwrap_or_default();
    assert!(cause.contains("race needs depth") && cause.contains("--level ug"), "{run}");
}

#[test]
fn flies_the_known_map_with_position_setpoints() {
    let rig = Rig::new();
    // This project accepts only position setpoints; elsewhere the example uses velocities.
    let grade = rig.grade(&["avoid", "--project=p2", "--seeds=1", "--image-rate=15", "--json"]);
    assert_eq!(grade["runs"][0]["outcome"], "finished", "{grade}");
}

/// Writes a plugin as a shell script; returns its path.
fn script(rig: &Rig, name: &str, text: &str) -> String {
    use std::os::unix::fs::PermissionsExt;
    let path = rig.at(name);
    fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    path
}

#[test]
fn failing_plugin_is_graded_with_its_cause() {
    let rig = Rig::new();
    let broken = script(&rig, "broken", "echo no such model >&2; exit 3");
    let (report, junit) = (rig.at("report"), rig.at("junit.xml"));
    let args = [
        broken.as_str(),
        "--project=forest",
        "--seeds=1",
        "--report",
        &report,
        "--junit",
        &junit,
        "--least=50",
        "--json",
    ];
    let output = rig.run(&args);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let grade: Value = serde_json::from_slice(&output.stdout).unwrap();
    let run = &grade["runs"][0];
    assert_eq!((&run["outcome"], &run["score"]), (&"plugin_failed".into(), &0.0.into()));
    let cause = run["cause"].as_str().unwrap();
    assert!(cause.contains("exit status 3") && cause.contains("no such model"), "{cause}");
    let page = fs::read_to_string(Path::new(&report).join("index.html")).unwrap();
    assert!(page.contains("id=\"day-1\"") && page.contains("no such model"), "{page}");
    let junit = fs::read_to_string(&junit).unwrap();
    assert!(junit.contains("failures=\"1\"") && junit.contains("no such model"), "{junit}");
    rig.good(&["verify", Path::new(&report).join("grade.json").to_str().unwrap()]);
}

#[test]
fn weather_variants_are_reproducible_and_recorded() {
    let rig = Rig::new();
    let flown = |jobs| {
        let variants = "--variants=night-rain,random:1";
        let forest = ["avoid", "--project=forest", "--seeds=1", "--image-rate=15", "--json"];
        rig.grade(&[&forest[..], &[variants, jobs]].concat())
    };
    let one = flown("--jobs=1");
    assert_eq!(one, flown("--jobs=2"), "bits do not depend on parallel flights");
    let variants = one["by_variant"].as_array().unwrap();
    let names: Vec<_> = variants.iter().map(|variant| &variant["variant"]).collect();
    assert_eq!(names, ["night-rain", "random-01"]);
    for variant in variants {
        let Value::Object(score) = &variant["summary"]["score"] else { panic!("{variant}") };
        assert!(score["low"].as_f64() <= score["value"].as_f64(), "{variant}");
    }
    let drawn = one["subject"]["environments"].as_object().unwrap();
    assert_eq!(drawn.keys().collect::<Vec<_>>(), ["random-01"]);
    assert_eq!(drawn["random-01"]["light"].as_array().unwrap().len(), 3);
    let runs = one["runs"].as_array().unwrap();
    assert_ne!(runs[0]["scene_sha256"], runs[1]["scene_sha256"]);
    assert_eq!(runs[0]["rules_sha256"], runs[1]["rules_sha256"]);
}

#[test]
fn rejects_invalid_arguments_before_any_flight() {
    let rig = Rig::new();
    rig.refused(&["avoid", "--project=p9"], "p2, p3");
    rig.refused(&["avoid", "--variants=noon"], "noon");
    rig.refused(&["avoid", "--variants=day,day"], "twice");
    rig.refused(&["avoid", "--variants=random:0"], "give random:1 to random:40");
    rig.refused(&["avoid", "--shard=3/2"], "is not a shard");
    rig.refused(&["avoid", "--image-rate=0"], "1 to 200 Hz");
    rig.refused(&["./gone.py"], "there is no plugin");
    rig.refused(&["verify", &rig.at("gone.json")], "cannot read");
    fs::write(rig.at("noise.json"), "{}").unwrap();
    rig.refused(&["verify", &rig.at("noise.json")], "is not a grade");
}

/// Returns the code block of this language in the guide about clusters.
fn block(language: &str) -> String {
    let guide = fs::read_to_string(root().join("docs/guides/grading-at-scale.md")).unwrap();
    let begin = guide.split_once(&format!("```{language}\n")).unwrap().1;
    begin.split_once("\n```").unwrap().0.to_owned()
}

/// Runs a shell script in which `vizflyt` only prints its arguments; returns its output.
fn called(rig: &Rig, shell: &[&str], environment: &[(&str, &str)]) -> String {
    let tools = rig.at("tools");
    fs::create_dir_all(&tools).unwrap();
    script(rig, "tools/vizflyt", "echo \"$@\"");
    let path = format!("{tools}:{}", std::env::var("PATH").unwrap());
    let output = Command::new(shell[0])
        .args(&shell[1..])
        .env("PATH", path)
        .envs(environment.iter().copied())
        .current_dir(rig.folder.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Returns whether the program accepts these arguments, by its message about a missing project.
fn is_understood(rig: &Rig, called: &str) -> bool {
    let given = called.trim().replace("--project p5", "--project p9");
    let args: Vec<&str> = given.split_whitespace().collect();
    let output =
        Command::new(vizflyt()).args(args).current_dir(rig.folder.path()).output().unwrap();
    String::from_utf8_lossy(&output.stderr).contains("there is no project 'p9'")
}

/// Acceptance test of the example plugin: at least 18 of 20 generated forests are flown without touching the true
/// geometry, at a mean speed of at least 2 m/s.
#[test]
fn example_flies_twenty_forests() {
    let grade = Rig::new().grade(&["avoid", "--project=forest", "--seeds=20", "--json"]);
    let runs = grade["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 20);
    let touched = |run: &Value| run["min_clearance_m"].as_f64().unwrap() <= 0.0;
    let (finished, failed): (Vec<_>, Vec<_>) =
        runs.iter().partition(|run| run["outcome"] == "finished" && !touched(run));
    assert!(failed.len() <= 2, "{failed:#?}");
    let figure = |run: &Value, name: &str| run[name].as_f64().unwrap();
    let speeds = finished.iter().map(|run| figure(run, "path_m") / figure(run, "seconds"));
    let mean_mps = speeds.sum::<f64>() / finished.len() as f64;
    assert!(mean_mps >= 2.0, "mean speed {mean_mps:.2} m/s");
}

#[test]
fn array_script_of_the_guide_flies_its_shard() {
    let rig = Rig::new();
    let file = script(&rig, "grade.sh", "");
    fs::write(&file, block("bash")).unwrap();
    let environment = [
        ("SLURM_ARRAY_JOB_ID", "77"),
        ("SLURM_ARRAY_TASK_ID", "3"),
        ("SLURM_ARRAY_TASK_COUNT", "16"),
        ("SLURM_CPUS_PER_TASK", "2"),
        ("HOME", rig.folder.path().to_str().unwrap()),
    ];
    let printed = called(&rig, &["bash", &file, vizflyt().to_str().unwrap(), "p5"], &environment);
    assert!(
        printed.contains("--shard 3/16") && printed.contains("parts-77/part-3.json"),
        "{printed}"
    );
    assert!(printed.starts_with("grade ") && is_understood(&rig, &printed), "{printed}");
    assert!(block("bash").contains("#SBATCH --array=1-16\n"));
}

#[test]
fn job_of_the_guide_flies_every_shard() {
    let rig = Rig::new();
    fs::write(rig.at("job.yaml"), block("yaml")).unwrap();
    let convert = "import json, sys, yaml; print(json.dumps(yaml.safe_load(open(sys.argv[1]))))";
    let output =
        Command::new("python3").args(["-c", convert, &rig.at("job.yaml")]).output().unwrap();
    assert!(output.status.success(), "install python3-yaml: {output:?}");
    let job: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&job["apiVersion"], &job["kind"]), (&"batch/v1".into(), &"Job".into()));
    let spec = &job["spec"];
    assert_eq!(spec["completionMode"], "Indexed");
    let parts = spec["completions"].as_u64().unwrap();
    let pod = &spec["template"]["spec"];
    assert_eq!(pod["restartPolicy"], "Never");
    // Every mount needs its volume.
    let named = |list: &Value| -> Vec<String> {
        let items = list.as_array().unwrap().iter();
        items.map(|item| item["name"].as_str().unwrap().to_owned()).collect()
    };
    let volumes = named(&pod["volumes"]);
    for container in pod["containers"]
        .as_array()
        .unwrap()
        .iter()
        .chain(pod["initContainers"].as_array().unwrap())
    {
        let mounts = named(&container["volumeMounts"]);
        assert!(mounts.iter().all(|mount| volumes.contains(mount)), "{mounts:?} {volumes:?}");
    }
    let container = &pod["containers"][0];
    assert_eq!(container["command"], serde_json::json!(["/bin/sh", "-c"]));
    let line = container["args"][0].as_str().unwrap();
    for index in [0, parts - 1] {
        let printed =
            called(&rig, &["sh", "-c", line], &[("JOB_COMPLETION_INDEX", &index.to_string())]);
        assert!(printed.contains(&format!("--shard {}/{parts}", index + 1)), "{printed}");
        assert!(printed.contains(&format!("part-{index}.json")), "{printed}");
        let known = printed.replace("/plugin", "avoid").replace("/keys/own", &rig.at("keys"));
        assert!(is_understood(&rig, &known), "{printed}");
    }
}

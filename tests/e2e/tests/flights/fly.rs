//! `vizflyt new` and `vizflyt fly` as a student uses them: the real binary, the simulated lab.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;
use vizflyt_e2e::{Demo, root, vizflyt};

/// Timeout for loading, baking, arming and climbing on a loaded machine.
const AIRBORNE: Duration = Duration::from_secs(90);
/// Timeout for a complete flight.
const FLIGHT: Duration = Duration::from_mins(4);
/// Timeout for building a plugin with its dependencies on a loaded machine.
const BUILT: Duration = Duration::from_mins(9);

/// A student's project is built without optimisation: the test is only about building and flying.
const OPT_LEVEL: (&str, &str) = ("CARGO_PROFILE_RELEASE_OPT_LEVEL", "0");

/// Temporary folder of a student.
struct StudentFolder(TempDir);

impl StudentFolder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, text).unwrap();
        path
    }
    /// Returns the command `vizflyt ARGS`, without this computer's settings.
    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(vizflyt());
        command.args(args).env("HOME", self.0.path()).env_remove("XDG_CONFIG_HOME");
        // The student's project uses our target folder, so that common dependencies are built once.
        command.env("CARGO_TARGET_DIR", vizflyt().ancestors().nth(2).unwrap());
        command.env(OPT_LEVEL.0, OPT_LEVEL.1);
        for folder in ["CARGO_HOME", "RUSTUP_HOME"] {
            let hidden = format!(".{}", folder.split('_').next().unwrap().to_lowercase());
            if let Some(home) = std::env::var_os("HOME")
                && std::env::var_os(folder).is_none()
            {
                command.env(folder, Path::new(&home).join(hidden));
            }
        }
        command
    }
    fn run(&self, args: &[&str]) -> Output {
        self.command(args).current_dir(self.0.path()).output().unwrap()
    }
    /// Runs a command that must fail, with an error line that contains every part.
    fn check_refused(&self, args: &[&str], parts: &[&str]) {
        let output = self.run(args);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success(), "{args:?} succeeded");
        let error =
            message.lines().rfind(|line| line.starts_with("error: ")).unwrap_or_else(|| {
                panic!("{args:?} reports no error: {message}");
            });
        for part in parts {
            assert!(error.contains(part), "{args:?} does not contain {part:?}: {message}");
        }
    }
    /// Starts a flight with its report in this folder.
    fn fly(&self, plugin: &Path, args: &[&str]) -> Demo {
        let mut command = self.command(&["fly", "--headless"]);
        command.arg(plugin).args(args);
        command.arg("--report").arg(self.path("report.json"));
        command.arg("--log-dir").arg(self.path("flights"));
        Demo::spawn(&mut command)
    }
    fn report(&self) -> Value {
        serde_json::from_str(&std::fs::read_to_string(self.path("report.json")).unwrap()).unwrap()
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_new_rust_plugin_is_tested_and_flies() {
    let student = StudentFolder::new();
    let folder = student.path("my-first");
    let made = student.run(&["new", text(&folder), "--lang", "rust"]);
    assert!(made.status.success(), "{made:?}");
    let mut flight = student.fly(&folder, &["--seconds", "12", "--seed", "4"]);
    let lab = flight.wait_for("lab ", BUILT);
    assert!(lab.contains("simulated"), "{lab}");
    flight.wait_for("plugin flies", AIRBORNE);
    let code = flight.wait(FLIGHT);
    let report = student.report();
    assert_eq!(report["outcome"], "landed", "{report:#} {:#?}", flight.seen);
    assert_eq!(code, Some(0));
    assert!(report["mean_speed_mps"].as_f64().unwrap() > 0.1, "it moves: {report:#}");
    // Run the project's own test, without a vehicle.
    let mut cargo = Command::new("cargo");
    cargo.args(["test", "--release", "-q"]).current_dir(&folder);
    cargo.env("CARGO_TARGET_DIR", vizflyt().ancestors().nth(2).unwrap());
    cargo.env(OPT_LEVEL.0, OPT_LEVEL.1);
    let tested = cargo.output().unwrap();
    assert!(tested.status.success(), "{}", String::from_utf8_lossy(&tested.stderr));
}

#[test]
fn prints_the_kind_of_lab_first() {
    let student = StudentFolder::new();
    let fingerprint = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
    let config = student.write(
        "jetson.toml",
        &format!(
            "[server]\naddress = \"127.0.0.1:9\"\nfingerprint = \"{fingerprint}\"\n\
             [vehicle]\nname = \"red\"\nmavlink = \"udpin:127.0.0.1:0\"\n[plugin]\npath = \"avoid\"\n"
        ),
    );
    // The configuration file of the working folder is used without an option.
    let output = student.run(&["fly", "--ready-within", "1"]);
    let output_text = String::from_utf8(output.stdout).unwrap();
    let first = output_text.lines().next().unwrap();
    for part in ["lab ", "real: server 127.0.0.1:9", "vehicle red", "jetson.toml"] {
        assert!(first.contains(part), "{output_text}");
    }
    assert!(!output.status.success());
    assert!(output_text.contains("error: not in the air after 1 s"), "{output_text}");

    // With the same file and `--sim`: the simulated lab.
    let mut flight = student.fly(
        Path::new("avoid"),
        &["--config", text(&config), "--sim", "--scene", "room", "--seconds", "2"],
    );
    assert!(flight.wait_for("lab ", AIRBORNE).contains("simulated"));
    flight.wait_for("plugin flies", AIRBORNE);
    assert_eq!(flight.wait(FLIGHT), Some(0), "{:#?}", flight.seen);
    assert_eq!(student.report()["outcome"], "landed");
}

#[test]
fn reloads_a_saved_plugin_while_the_vehicle_holds() {
    let student = StudentFolder::new();
    // A program that can be saved: a script that starts the built-in example.
    let save = |version: &str| {
        let text =
            format!("#!/bin/sh\n# {version}\nexec {} plugin avoid \"$@\"\n", text(&vizflyt()));
        let path = student.write("mine", &text);
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o755))
            .unwrap();
        path
    };
    let plugin = save("one");
    let mut flight = student.fly(&plugin, &["--watch", "--scene", "room", "--seconds", "20"]);
    flight.wait_for("plugin flies", AIRBORNE);
    let before = flight.descendants("plugin avoid");
    save("number two");
    flight.wait_for("reloading the plugin", AIRBORNE);
    flight.wait_for("holding: the plugin is being started again", AIRBORNE);
    flight.wait_for("the plugin flies again", AIRBORNE);
    let after = flight.descendants("plugin avoid");
    assert_eq!((before.len(), after.len()), (1, 1), "one plugin at a time");
    assert_ne!(before, after, "another process flies");
    assert_eq!(flight.wait(FLIGHT), Some(0), "{:#?}", flight.seen);
    let report = student.report();
    assert!(report["outcome"] == "landed" || report["outcome"] == "finished", "{report:#}");
}

#[test]
fn new_python_plugin_is_complete_except_for_the_package() {
    let student = StudentFolder::new();
    let made = student.run(&["new", "first"]);
    assert!(made.status.success());
    let package = root().join("jetson/python").canonicalize().unwrap();
    let said = String::from_utf8_lossy(&made.stdout).into_owned();
    assert!(said.contains(&format!("pip install {} -r first/requirements.txt", text(&package))));
    for file in ["plugin.py", "test_plugin.py", "README.md", "vizflyt.toml", "requirements.txt"] {
        let text = std::fs::read_to_string(student.path("first").join(file)).unwrap();
        assert!(!text.contains("{{"), "{file}: {text}");
    }
    let required = std::fs::read_to_string(student.path("first/requirements.txt")).unwrap();
    assert!(
        required.starts_with(&format!("vizflyt=={}\n", env!("CARGO_PKG_VERSION"))),
        "{required}"
    );
    // With a Python without the package, the error names the missing package and the command to install it.
    let python = student.write(
        "first/.venv/bin/python3",
        "#!/bin/sh\necho \"ModuleNotFoundError: No module named 'vizflyt'\" >&2\nexit 1\n",
    );
    std::fs::set_permissions(&python, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let parts = ["first/.venv/bin/python3 cannot import", "ModuleNotFoundError", "pip install"];
    student.check_refused(&["fly", "first"], &parts);
}

#[test]
fn errors_name_the_remedy() {
    let student = StudentFolder::new();
    student.check_refused(&["fly"], &["no plugin given", "[plugin]"]);
    student.check_refused(&["fly", "./none"], &["no plugin at ./none", "vizflyt new", "avoid"]);
    student.check_refused(&["fly", "none.py"], &["no plugin at none.py"]);
    student.write("notes.txt", "");
    student.check_refused(&["fly", "notes.txt"], &["chmod +x notes.txt"]);
    student.check_refused(
        &["fly", "avoid", "--mavlink", "udpin:127.0.0.1:0"],
        &["--mavlink is for the real lab", "--server"],
    );
    let with_server = ["fly", "avoid", "--server", "127.0.0.1:9", "--scene", "race"];
    student.check_refused(&with_server, &["--scene", "simulated lab", "--sim"]);
    student.check_refused(&["fly", "avoid", "--scene", "forrest"], &["forrest", "forest, race"]);
    student.write("bad.toml", "[limits]\nmax_sped_mps = 2\n");
    student.check_refused(
        &["fly", "avoid", "--config", "bad.toml"],
        &["bad.toml: line 2", "did you mean 'max_speed_mps'"],
    );
    student.check_refused(&["fly", "avoid", "--config", "gone.toml"], &["gone.toml"]);

    student.check_refused(&["new", "2nd", "--lang", "rust"], &["'2nd' is not a valid plugin name"]);
    student.check_refused(&["new", "avoid", "--lang", "rust"], &["built-in"]);
    student.check_refused(&["new", "x", "--lang", "cobol"], &["cobol"]);
    student
        .check_refused(&["new", "x", "--lang", "rust", "--project", "p99"], &["no project 'p99'"]);
    assert!(!student.path("x").exists(), "nothing is left behind");
    student.write("full/file", "");
    student.check_refused(&["new", "full", "--lang", "python"], &["exists already"]);
    student.write("projects/p99/arena.toml", "");
    let made = student.run(&["new", "x", "--lang", "rust", "--project", "p99"]);
    assert!(made.status.success(), "{made:?}");
    let lab = std::fs::read_to_string(student.path("x/vizflyt.toml")).unwrap();
    assert!(lab.contains("projects/p99"), "{lab}");
    student.write("y/Cargo.toml", "[package]\nname = \"y\"\nversion = \"0.1.0\"\n[workspace]\n");
    student.write("y/src/main.rs", "fn main() { not rust }");
    student.check_refused(&["fly", "y"], &["y does not build"]);
}

//! Attacks by a plugin on its confinement.

use std::fs;
use std::os::unix::net::UnixListener;

use super::*;

/// Whether this computer offers cells. If not, prints the reason, and the tests pass without checks.
fn has_cells() -> bool {
    let why = Confinement::prepare(&PluginLimits::default(), &[]).unsealed();
    if let Some(why) = &why {
        println!("skipped: {why}");
    }
    why.is_none()
}

fn graded() -> PluginLimits {
    PluginLimits { graded: true, ..PluginLimits::default() }
}

#[test]
fn hides_other_processes_and_homes() {
    if !has_cells() {
        return;
    }
    let home = std::env::home_dir().unwrap();
    let private = tempfile::Builder::new().prefix("vizflyt-test-").tempdir_in(&home).unwrap();
    // If the tests were built in /tmp, their own folder is visible there.
    let program = std::env::current_exe().unwrap();
    let own = program.strip_prefix("/tmp").ok().and_then(|path| path.iter().next());
    let own = own.map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let program = format!(
        "
import os, socket
print([int(p) for p in os.listdir('/proc') if p.isdigit()])
print([n for n in os.listdir('/tmp') if n != {own:?}], os.listdir('/dev/shm'), [n for n in os.listdir({home:?}) if 'vizflyt-test' in n])
print(socket.gethostname() != '', os.listdir('/sys/class/net') and open('/proc/net/dev').read().count(':'))"
    );
    let (output, _) = python(&graded(), &program);
    let lines: Vec<&str> = output.lines().collect();
    assert_eq!(&lines[..2], ["[2]", "[] [] []"], "{output}");
    assert_eq!(lines[2], "True 1", "its only network is `lo`");
    drop(private);
}

/// PID 1 of a cell is a copy of the runtime, with its command line and memory.
#[test]
fn hides_the_files_of_init() {
    if !has_cells() {
        return;
    }
    let program = "
import os
for name in 'cmdline', 'environ', 'mem', 'maps', 'fd', 'cwd', 'root', 'exe', 'status', 'task/1/cmdline', 'net/dev':
    for look in os.listdir, os.readlink, lambda path: os.open(path, os.O_RDONLY):
        try:
            print(name, look(f'/proc/1/{name}'))
        except OSError:
            pass
print(os.access('/proc/1', os.F_OK), os.path.exists('/proc/2/cmdline'), os.path.exists('/proc/cpuinfo'))";
    for limits in [graded(), PluginLimits::default()] {
        let (output, _) = python(&limits, program);
        assert_eq!(output, "False True True");
    }
}

#[test]
fn ends_daemons_of_the_plugin() {
    let (_, sentence) = to_the_end(&["sh", "-c", "setsid sleep 1000.125 & sleep 0.2"]);
    assert!(sentence.contains("exit status 0"), "{sentence}");
    if has_cells() {
        until_gone("1000.125");
    }
}

#[test]
fn blocks_connections_to_other_programs() {
    let folder = tempfile::Builder::new().prefix("vizflyt-test-").tempdir_in("/tmp").unwrap();
    let path = folder.path().join("service");
    let _service = UnixListener::bind(&path).unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    fs::set_permissions(folder.path(), open).unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    fs::set_permissions(&path, open).unwrap();
    let program = format!("import socket; socket.socket(socket.AF_UNIX).connect({path:?})");
    let (_, sentence) = python(&PluginLimits::default(), &program);
    assert!(sentence.contains("Network is unreachable"), "{sentence}");
    if has_cells() {
        let limits = PluginLimits { network: true, ..PluginLimits::default() };
        let (_, sentence) = python(&limits, &program);
        assert!(sentence.contains("No such file"), "{sentence}");
    }
}

#[test]
fn forbids_changing_other_processes_and_making_namespaces() {
    let program = "
import ctypes, os, resource
libc = ctypes.CDLL(None, use_errno=True)
def call(name, *arguments):
    ctypes.set_errno(0)
    result = getattr(libc, name)(*arguments)
    print(name, 'passed' if result >= 0 else os.strerror(ctypes.get_errno()))
def refused(name, act):
    try:
        act(); print(name, 'passed')
    except PermissionError as error:
        print(name, error.strerror)
parent = os.getppid()
refused('prlimit', lambda: resource.prlimit(parent, resource.RLIMIT_CPU, (1, 1)))
refused('setpriority', lambda: os.setpriority(os.PRIO_PROCESS, parent, 19))
call('syscall', 56, 0x10000000 | 0x40000000 | 17, 0, 0, 0, 0)
call('syscall', 435, 0, 0)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0)); print('own limits')";
    let program = if cfg!(target_arch = "aarch64") {
        program.replace("'syscall', 56", "'syscall', 220")
    } else {
        program.to_owned()
    };
    let (output, _) = python(&PluginLimits::default(), &program);
    let expected = "prlimit Operation not permitted\nsetpriority Operation not permitted\n\
                    syscall Operation not permitted\nsyscall Function not implemented\nown limits";
    assert_eq!(output, expected);
}

#[test]
fn graded_flights_start_clean_and_leave_no_files() {
    let folder = tempfile::tempdir_in("/var/tmp").unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    fs::set_permissions(folder.path(), open).unwrap();
    let script = folder.path().join("plugin.py");
    let program = "
import os
print(os.path.exists('/tmp/left'), os.path.exists('/dev/shm/left'), os.getcwd())
for path in ('/tmp/left', '/dev/shm/left'): open(path, 'w').write('x')
print(sorted(name for name in os.environ if 'SECRET' in name or name.startswith('CARGO')))
open('left', 'w')";
    fs::write(&script, program).unwrap();
    for _ in 0..2 {
        let command = ["python3", script.to_str().unwrap()];
        let (lines, sentence) = to_the_end_with(&graded(), &command);
        if has_cells() {
            // Lines of the other pipe may come first.
            let printed = lines.iter().filter(|(stream, _)| *stream == Stream::Stdout);
            let lines: Vec<&str> = printed.map(|(_, line)| line.as_str()).collect();
            let expected = format!("False False {}", folder.path().display());
            assert_eq!(lines, [&expected[..], "[]"], "{sentence}");
            assert!(sentence.contains("Read-only file system"), "{sentence}");
        }
        assert!(!folder.path().join("left").exists());
    }
}

/// A plugin can start in a folder that its cell covers, for example a home folder.
#[test]
fn starts_in_a_covered_folder() {
    if !has_cells() {
        return;
    }
    let folder = tempfile::tempdir_in("/var/tmp").unwrap();
    let deep = folder.path().join("home/me");
    fs::create_dir_all(&deep).unwrap();
    fs::write(deep.join("private"), "private").unwrap();
    let limits = PluginLimits { folder: Some(deep.clone()), ..PluginLimits::default() };
    let (lines, sentence) = to_the_end_with(&limits, &["sh", "-c", "pwd; ls"]);
    let lines: Vec<&str> = lines.iter().map(|(_, line)| line.as_str()).collect();
    assert_eq!(lines, [deep.to_str().unwrap()], "{sentence}");
}

/// Python environments contain the link `lib64 -> lib`.
#[test]
fn makes_a_cell_if_a_shown_folder_contains_links() {
    let folder = tempfile::tempdir().unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(folder.path(), open).unwrap();
    for name in ["bin", "lib"] {
        fs::create_dir(folder.path().join(name)).unwrap();
    }
    let bin = folder.path().join("bin/tool");
    fs::write(folder.path().join("lib/x"), "found\n").unwrap();
    fs::write(&bin, "#!/bin/sh\ncat \"$(dirname \"$0\")/../lib64/x\"\n").unwrap();
    fs::set_permissions(&bin, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    std::os::unix::fs::symlink("lib", folder.path().join("lib64")).unwrap();
    // The environment itself may be a link to another folder.
    let own = tempfile::tempdir().unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(own.path(), open).unwrap();
    std::os::unix::fs::symlink(folder.path(), own.path().join("venv")).unwrap();
    let by_link = own.path().join("venv/bin/tool");
    let limits = PluginLimits {
        folder: Some(own.path().to_owned()),
        write: vec![own.path().to_owned()],
        ..PluginLimits::default()
    };
    let (lines, sentence) = to_the_end_with(&limits, &[by_link.to_str().unwrap()]);
    assert!(lines.iter().any(|(_, line)| line == "found"), "{lines:?} {sentence}");
    let confinement = Confinement::prepare(&limits, &[by_link.into()]);
    assert!(!has_cells() || confinement.unsealed().is_none(), "{:?}", confinement.unsealed());
    let limits = PluginLimits {
        folder: Some(folder.path().to_owned()),
        write: vec![folder.path().to_owned()],
        ..PluginLimits::default()
    };
    let confinement = Confinement::prepare(&limits, &[bin.clone().into()]);
    assert!(!has_cells() || confinement.unsealed().is_none(), "{:?}", confinement.unsealed());
    let (lines, sentence) = to_the_end_with(&limits, &[bin.to_str().unwrap()]);
    assert!(lines.iter().any(|(_, line)| line == "found"), "{lines:?} {sentence}");
}

/// A student's folder with links to a folder of the instructor.
#[test]
fn follows_no_link_out_of_a_students_folder() {
    if !has_cells() {
        return;
    }
    let open = || std::os::unix::fs::PermissionsExt::from_mode(0o755);
    let outer = tempfile::tempdir_in("/var/tmp").unwrap();
    fs::set_permissions(outer.path(), open()).unwrap();
    let victim = outer.path().join("victim");
    fs::create_dir_all(victim.join("bin")).unwrap();
    fs::write(victim.join("secret"), "").unwrap();
    std::os::unix::fs::symlink("/usr/bin/python3", victim.join("bin/python3")).unwrap();
    let own = outer.path().join("own");
    let script = own.join("plugin.py");
    for (aim, link) in [
        ("bin/python3", "/usr/bin/python3"),
        ("bin/python3", victim.join("bin/python3").to_str().unwrap()),
        ("lib", victim.to_str().unwrap()),
        ("lib64", "../../victim"),
        ("pyvenv.cfg", victim.join("secret").to_str().unwrap()),
    ] {
        let _ = fs::remove_dir_all(&own);
        fs::create_dir_all(own.join(".venv/bin")).unwrap();
        fs::write(
            &script,
            format!("import os; print(os.path.exists({:?}))", victim.join("secret")),
        )
        .unwrap();
        let python = own.join(".venv/bin/python3");
        std::os::unix::fs::symlink(link, own.join(".venv").join(aim)).unwrap();
        let _ = std::os::unix::fs::symlink("/usr/bin/python3", &python);
        let command = [python.to_str().unwrap(), script.to_str().unwrap()];
        for limits in [PluginLimits::default(), graded()] {
            let (lines, sentence) = to_the_end_with(&limits, &command);
            assert!(!lines.iter().any(|(_, line)| line == "True"), "{aim}: {lines:?} {sentence}");
            let is_started = lines.iter().any(|(_, line)| line == "False");
            assert!(is_started, "{aim}: {lines:?} {sentence}");
        }
    }
    // The student's code replaces its folder by a link after the cell was prepared.
    let limits = PluginLimits { write: vec![own.clone()], ..graded() };
    let confinement = Confinement::prepare(&limits, &[]);
    fs::rename(&own, outer.path().join("old")).unwrap();
    std::os::unix::fs::symlink(&victim, &own).unwrap();
    let mut shell = confinement.command("sh");
    shell.args(["-c", "ls", own.to_str().unwrap()]);
    assert!(confinement.run(shell, WAIT).is_err());
}

#[test]
fn counts_memory_of_all_descendants() {
    if !has_cells() {
        return;
    }
    let limits = PluginLimits { memory_mb: 200, ..PluginLimits::default() };
    let program = "
import os, time
for _ in range(4):
    if os.fork() == 0:
        os.setsid()
        held = bytearray(b'x') * 100_000_000
        time.sleep(1000)
time.sleep(1000)";
    let (_, sentence) = python(&limits, program);
    assert!(sentence.contains("more than its 200 MB of memory"), "{sentence}");
    let (output, sentence) = python(&limits, "open('/dev/shm/x', 'wb').write(bytes(60_000_000))");
    assert!(sentence.contains("No space left on device"), "{output} {sentence}");
}

#[test]
fn runs_a_tool_to_its_end_or_its_timeout() {
    let confinement = Confinement::prepare(&PluginLimits::default(), &[]);
    let shell = |script: &str| {
        let mut shell = confinement.command("sh");
        shell.args(["-c", script]).stdout(Stdio::piped()).stderr(Stdio::piped());
        shell
    };
    let output = confinement.run(shell("echo out; echo err >&2; exit 3"), WAIT).unwrap();
    assert_eq!((&output.stdout[..], &output.stderr[..]), (&b"out\n"[..], &b"err\n"[..]));
    assert_eq!(output.status.code(), Some(3));
    let soon = Duration::from_millis(300);
    let error = confinement.run(shell("sleep 1000.25"), soon).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::TimedOut, "{error}");
    until_gone("1000.25");
}

#[test]
fn removes_control_characters_from_output() {
    let (mut lines, _) =
        to_the_end(&["sh", "-c", r"printf '\033[31mred\r\n'; printf '\033]0;x\007\n' >&2"]);
    lines.sort_by_key(|(stream, _)| *stream != Stream::Stdout);
    let lines: Vec<_> = lines.into_iter().map(|(_, line)| line).collect();
    assert_eq!(lines, ["\u{fffd}[31mred", "\u{fffd}]0;x\u{fffd}"]);
}

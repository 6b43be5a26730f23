//! Confinement of the plugin, applied between fork and exec.
//!
//! | restricts | mechanism | if unavailable |
//! |---|---|---|
//! | memory, processes | control group | `RLIMIT_DATA` and `RLIMIT_NPROC`, and counting by the supervisor |
//! | processors | control group | the plugin is kept off the first processor |
//! | network, other programs' sockets, the system itself | seccomp | reported once |
//! | writing outside its folders, reading hidden files, signalling other processes | Landlock | reported once |
//! | other processes, home folders, shared memory and files | a [cell](super::cell) | reported once |
//! | the runtime's user | another user, if root | the plugin stays root without capabilities |
//!
//! Everything is prepared before the fork; after it only system calls are made.

#![allow(unsafe_code, reason = "system calls between fork and exec, where little is allowed")]

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::available_parallelism;

use landlock::{
    ABI, Access, AccessFs, CompatLevel, Compatible, Ruleset, RulesetAttr, RulesetCreatedAttr,
    RulesetError, Scope, path_beneath_rules,
};
use nix::libc;
use nix::sched::CpuSet;
use nix::sys::resource::{Resource, setrlimit};
use nix::sys::signal::Signal;
use nix::unistd::{Gid, Pid, Uid, User, geteuid, getppid};
use seccompiler::{
    BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition, SeccompFilter,
    SeccompRule,
};

use vizflyt_sdk::ipc::PluginSocket;

use super::cell::{Cell, Places};
use super::cgroup::{Cgroup, Controller};
use super::limits::PluginLimits;

/// Confinement of a plugin, for any number of starts.
#[derive(Debug)]
pub struct Confinement {
    pub(super) limits: PluginLimits,
    user: Option<(Uid, Gid)>,
    /// Whether the plugin stays root without capabilities.
    drops_powers: bool,
    filters: Vec<BpfProgram>,
    landlock: Option<OwnedFd>,
    /// The cell, or the reason why none is available.
    cell: Result<Cell, String>,
    own_folders: Vec<PathBuf>,
    notes: Vec<String>,
}

/// Limits of one process, in addition to the confinement.
pub(super) struct Bounds {
    group: Cgroup,
    memory: Option<u64>,
    processes: Option<u64>,
    processors: Option<CpuSet>,
    in_cell: bool,
}

impl Confinement {
    /// Selects the mechanisms that this kernel and this user offer for `command` under `limits`.
    pub fn prepare(limits: &PluginLimits, command: &[OsString]) -> Self {
        let mut notes = Vec::new();
        let own_folders = own_folders(limits, command);
        let (mut user, mut drops_powers) = choose_user(limits, command, &mut notes);
        let cell = cell(limits, command, &own_folders);
        match &cell {
            // The cell's user: in a cell, the path to shown files is open regardless of folder permissions.
            Ok(cell) if geteuid().is_root() => {
                (user, drops_powers) = (cell.user(), false);
                notes.clear();
            }
            Ok(_) => {}
            Err(why) => notes.push(format!(
                "the plugin runs without namespaces ({why}); it sees other processes and shared folders"
            )),
        }
        let filters = match filters(limits, cell.is_ok()) {
            Ok(filters) if seccomp_is_there() => filters,
            result => {
                let why = result.err().map(|error| format!(": {error}")).unwrap_or_default();
                notes.push(format!("this kernel has no seccomp{why}; the plugin has the network"));
                Vec::new()
            }
        };
        let landlock = match files(&own_folders, limits, cell.is_ok()) {
            Ok(Some(ruleset)) => Some(ruleset),
            Ok(None) => {
                let note = "this kernel has no Landlock; the plugin may write where its user may";
                notes.push(note.to_owned());
                None
            }
            Err(error) => {
                notes.push(format!("Landlock: {error}; the plugin may write where its user may"));
                None
            }
        };
        let limits = limits.clone();
        Self { limits, user, drops_powers, filters, landlock, cell, own_folders, notes }
    }

    /// Returns the plugin's user, if it differs from the runtime's.
    pub fn user_id(&self) -> Option<u32> {
        self.user.map(|(uid, _)| uid.as_raw())
    }

    /// Whether the kernel lacks Landlock, seccomp, or what a cell needs.
    pub fn is_partial(&self) -> bool {
        self.landlock.is_none() || self.filters.is_empty() || self.cell.is_err()
    }

    /// Returns why this computer must not sign grades, as a sentence: without a cell, or without a filter of system
    /// calls, a plugin can search for hidden data.
    pub fn unsealed(&self) -> Option<String> {
        match &self.cell {
            Err(why) => Some(format!("plugins run without namespaces on this computer: {why}")),
            Ok(_) if self.filters.is_empty() => Some("this kernel has no seccomp".to_owned()),
            Ok(_) => None,
        }
    }

    /// Returns the folders of the student's own code.
    pub(super) fn own_folders(&self) -> &[PathBuf] {
        &self.own_folders
    }

    /// Makes a control group, and substitutes for the limits that it lacks. Also returns notes on missing mechanisms.
    pub(super) fn bounds(&self) -> (Bounds, Vec<String>) {
        let limits = &self.limits;
        let group = Cgroup::make(limits);
        let mut notes = self.notes.clone();
        let mut missing = Vec::new();
        let mut without = |controller, name: &'static str| {
            let lacks = !group.limits(controller);
            missing.extend(lacks.then_some(name));
            lacks
        };
        let memory = without(Controller::Memory, "memory").then_some(limits.memory_mb * 1_000_000);
        let processes = without(Controller::Pids, "processes").then(|| {
            // The kernel counts all processes of the user, so the limit is added to those that run.
            let uid = self.user.map_or(geteuid(), |(uid, _)| uid);
            tasks_of(uid) + u64::from(limits.processes)
        });
        let processors =
            without(Controller::Cpu, "processors").then(|| but_the_first(limits.cpus)).flatten();
        if !missing.is_empty() {
            notes.push(format!(
                "no control group for {}; limited process by process instead",
                missing.join(" and ")
            ));
        }
        let in_cell = self.cell.is_ok();
        (Bounds { group, memory, processes, processors, in_cell }, notes)
    }

    /// Makes `process` confine itself between fork and exec.
    pub(super) fn apply(
        &self,
        process: &mut Command,
        bounds: &Bounds,
        socket: Option<PluginSocket>,
    ) {
        let parent = nix::unistd::getpid();
        let doors: Vec<i32> = bounds.group.doors().into_iter().map(File::as_raw_fd).collect();
        let landlock = self.landlock.as_ref().map(AsRawFd::as_raw_fd);
        let (user, drops_powers) = (self.user, self.drops_powers);
        let cell = self.cell.as_ref().ok().cloned();
        let (memory, processes) = (bounds.memory, bounds.processes);
        let processors = bounds.processors;
        let filters = self.filters.clone();
        let steps = move || -> io::Result<()> {
            if let Some(socket) = &socket {
                socket.let_inherit()?;
            }
            for &door in &doors {
                // SAFETY: writes a byte that outlives the call to a file that our parent holds.
                let written = unsafe { libc::write(door, b"0".as_ptr().cast(), 1) };
                explained(check(written), "it cannot join its control group")?;
            }
            if let Some(processors) = &processors {
                nix::sched::sched_setaffinity(Pid::from_raw(0), processors)?;
            }
            // A new session has no terminal, into which the plugin could type, and is a process group that the
            // supervisor can kill.
            nix::unistd::setsid()?;
            nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
            // The parent may have ended before the call.
            if getppid() != parent {
                return Err(io::ErrorKind::BrokenPipe.into());
            }
            if let Some(cell) = &cell {
                cell.enter().or_else(|(step, error)| explained(Err(error), step))?;
            }
            for (resource, most) in
                [(Resource::RLIMIT_DATA, memory), (Resource::RLIMIT_NPROC, processes)]
            {
                if let Some(most) = most {
                    explained(lower(resource, most), "its limits cannot be set")?;
                }
            }
            if let Some((uid, gid)) = user.filter(|_| cell.is_none()) {
                explained(become_user(uid, gid), "it cannot become another user")?;
                // The change of user has cleared the setting.
                nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
            }
            if drops_powers {
                drop_capabilities();
            }
            nix::sys::prctl::set_no_new_privs()?;
            if let Some(landlock) = landlock {
                if let Some(cell) = &cell {
                    explained(cell.allow_scratch(landlock), "Landlock refuses its scratch space")?;
                }
                // SAFETY: landlock_restrict_self(2) with a ruleset that our parent holds.
                let done = unsafe { libc::syscall(libc::SYS_landlock_restrict_self, landlock, 0) };
                explained(check(done as isize), "Landlock refuses")?;
            }
            for filter in &filters {
                // seccompiler's errors hold no memory; their text is for kernel developers.
                let applied = seccompiler::apply_filter(filter);
                explained(
                    applied.map_err(|_| io::ErrorKind::Unsupported.into()),
                    "seccomp refuses",
                )?;
            }
            Ok(())
        };
        // SAFETY: between fork and exec only async-signal-safe calls are allowed. `steps` makes
        // system calls with data that was prepared before, and allocates nothing.
        unsafe { process.pre_exec(steps) };
    }
}

impl Bounds {
    pub(super) fn group(&self) -> &Cgroup {
        &self.group
    }

    pub(super) fn in_cell(&self) -> bool {
        self.in_cell
    }

    /// Whether the supervisor must count memory and processes because no control group does.
    pub(super) fn counts_itself(&self) -> bool {
        self.memory.is_some() || self.processes.is_some()
    }
}

/// Returns `result`. On an error, first writes `what` to standard error, which the supervisor reads:
/// the standard library passes only an error number to the parent.
fn explained(result: io::Result<()>, what: &'static str) -> io::Result<()> {
    if result.is_err() {
        for part in ["confining the plugin: ", what, "\n"] {
            // SAFETY: writes static bytes to the process's standard error.
            unsafe { libc::write(2, part.as_ptr().cast(), part.len()) };
        }
    }
    result
}

fn check(result: isize) -> io::Result<()> {
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Lowers a limit; keeps a limit that is already lower.
fn lower(resource: Resource, most: u64) -> io::Result<()> {
    let (_, hard) = nix::sys::resource::getrlimit(resource)?;
    let most = most.min(hard);
    Ok(setrlimit(resource, most, most)?)
}

/// Changes to another user permanently.
fn become_user(uid: Uid, gid: Gid) -> io::Result<()> {
    nix::unistd::setgroups(&[])?;
    nix::unistd::setresgid(gid, gid, gid)?;
    Ok(nix::unistd::setresuid(uid, uid, uid)?)
}

/// Empties the bounding set, so that root has no capabilities after exec (capabilities(7)).
fn drop_capabilities() {
    for capability in 0..64 {
        // SAFETY: prctl(2) with numbers only. An unknown capability, or one that may not be dropped,
        // is an error without effect.
        unsafe { libc::prctl(libc::PR_CAPBSET_DROP, capability, 0, 0, 0) };
    }
}

/// Makes the plugin's cell, with its folders, its program, and the folders of its interpreter's packages.
fn cell(limits: &PluginLimits, command: &[OsString], own: &[PathBuf]) -> Result<Cell, String> {
    let user = if geteuid().is_root() {
        let name = limits.user.as_deref().filter(|&name| name != "root");
        let names = name.map_or(vec!["vizflyt", "nobody"], |name| vec![name]);
        let user = names.iter().find_map(|name| User::from_name(name).ok().flatten());
        let user = user.ok_or_else(|| format!("there is no user {}", names.join(" or ")))?;
        Some((user.uid, user.gid))
    } else {
        None
    };
    let mut readable = limits.read.clone();
    let untrusted = untrusted(limits, command);
    let is_untrusted = |path: &Path| {
        untrusted.iter().any(|(folder, full)| path.starts_with(folder) || path.starts_with(full))
    };
    for path in command.iter().filter_map(|path| std::path::absolute(path).ok()) {
        if path.exists() {
            readable.extend(if is_untrusted(&path) { vec![path] } else { links(&path) });
        }
    }
    if let Some(program) = command.first().map(Path::new) {
        let is_bare = program.components().count() == 1;
        // Files next to a program belong to it, for example models and libraries.
        let beside = program.parent().and_then(|folder| std::path::absolute(folder).ok());
        let is_shown = |folder: &PathBuf| folder.canonicalize().is_ok_and(|it| is_somebodys(&it));
        readable.extend(beside.filter(|folder| !is_bare && is_shown(folder)));
        let program = is_bare.then(|| on_path(program)).flatten().unwrap_or(program.to_owned());
        let program = std::path::absolute(&program).unwrap_or(program);
        if is_untrusted(&program) {
            readable.extend(environment(&program));
        } else {
            let programs = links(&program);
            readable.extend(programs.iter().flat_map(|program| installation(program)));
            readable.extend(programs);
        }
    }
    for name in ["PYTHONPATH", "VIRTUAL_ENV", "LD_LIBRARY_PATH"] {
        readable.extend(std::env::split_paths(&std::env::var_os(name).unwrap_or_default()));
    }
    readable.extend(std::env::home_dir().map(|home| home.join(".local/lib")));
    if limits.network {
        // Configuration of the name resolver.
        readable.extend(["/run/systemd/resolve", "/run/resolvconf"].map(PathBuf::from));
    }
    let mut writable = limits.write.clone();
    if limits.graded { &mut readable } else { &mut writable }.extend_from_slice(own);
    let folder = limits.folder.clone().or_else(|| {
        if limits.graded { own.first().cloned() } else { std::env::current_dir().ok() }
    });
    let folder = folder.unwrap_or_else(|| PathBuf::from("/tmp"));
    let places = Places { readable, writable, hidden: limits.hide.clone(), untrusted, folder };
    Cell::prepare(user, limits.network, &places, (limits.memory_mb / 4).max(16))
}

/// Returns the student's folders by their given and their canonical paths.
fn untrusted(limits: &PluginLimits, command: &[OsString]) -> Vec<(PathBuf, PathBuf)> {
    let folders = scripts(command).into_iter().chain(limits.untrusted.iter().cloned());
    let both =
        |folder: PathBuf| Some((std::path::absolute(&folder).ok()?, folder.canonicalize().ok()?));
    folders.filter_map(both).filter(|(_, folder)| is_somebodys(folder)).collect()
}

/// Returns the paths that a program in a student's folder needs: those next to its `bin`, and the Python of its virtual
/// environment.
fn environment(program: &Path) -> Vec<PathBuf> {
    let mut shown = installation(program);
    let python = program.canonicalize().unwrap_or_default();
    if is_python(&python) {
        shown.extend(links(program));
    }
    // The environment finds its libraries by this setting, which may contain links of an installer.
    let config = program.ancestors().nth(2).map(|prefix| prefix.join("pyvenv.cfg"));
    let config = config.filter(|path| path.symlink_metadata().is_ok_and(|it| it.is_file()));
    let text = config.and_then(|path| fs::read_to_string(path).ok()).unwrap_or_default();
    let home = text.lines().filter_map(|line| line.split_once('='));
    let home = home.filter(|(key, _)| key.trim() == "home");
    let home = home.map(|(_, home)| Path::new(home.trim()).join("python3"));
    let pythons = [python].into_iter().chain(home.filter(|path| path.is_absolute()));
    for python in pythons.filter(|path| is_python(path)) {
        shown.extend(installation(&python));
        shown.push(python);
    }
    shown
}

/// Whether a program is an installed Python: `bin/python3`, with libraries next to `bin`.
pub fn is_python(program: &Path) -> bool {
    let name = program.file_name().unwrap_or_default().to_string_lossy();
    let bin = program.parent().filter(|folder| folder.ends_with("bin"));
    let Some(prefix) = bin.and_then(Path::parent) else { return false };
    let libraries = ["lib", "lib64"].map(|lib| fs::read_dir(prefix.join(lib)));
    let mut libraries = libraries.into_iter().flatten().flatten().flatten();
    let is_library = |entry: fs::DirEntry| {
        entry.file_name().to_string_lossy().starts_with("python3")
            && entry.path().join("os.py").is_file()
    };
    name.starts_with("python3") && program.is_file() && libraries.any(is_library)
}

/// Returns `path` and all targets of its chain of symbolic links, at most 16 paths.
fn links(path: &Path) -> Vec<PathBuf> {
    let next = |path: &PathBuf| {
        Some(path.parent().unwrap_or(Path::new("")).join(fs::read_link(path).ok()?))
    };
    std::iter::successors(Some(path.to_owned()), next).take(16).collect()
}

/// Returns the folders of a program's installation, for example of a Python environment: those next to its `bin`. For a
/// version manager (pyenv, asdf, mise), which starts programs by scripts in `shims`, returns its complete folder.
fn installation(program: &Path) -> Vec<PathBuf> {
    if let Some(shims) = program.parent().filter(|folder| folder.ends_with("shims")) {
        return shims.parent().map(Path::to_owned).into_iter().collect();
    }
    let bin = program.parent().filter(|folder| folder.ends_with("bin"));
    let Some(prefix) = bin.and_then(Path::parent) else { return Vec::new() };
    // An environment may be a link to another folder.
    let prefixes = [Some(prefix.to_owned()), prefix.canonicalize().ok()].into_iter().flatten();
    let parts = |prefix: PathBuf| ["bin", "lib", "lib64", "pyvenv.cfg"].map(|it| prefix.join(it));
    prefixes.flat_map(parts).collect()
}

/// Chooses the plugin's user. The flag is true if the plugin stays root and must drop its capabilities.
fn choose_user(
    limits: &PluginLimits,
    command: &[OsString],
    notes: &mut Vec<String>,
) -> (Option<(Uid, Gid)>, bool) {
    if !geteuid().is_root() {
        return (None, false);
    }
    let named = |name: &str| User::from_name(name).ok().flatten();
    let user = match &limits.user {
        Some(name) if name == "root" => None,
        Some(name) => {
            let user = named(name);
            if user.is_none() {
                notes.push(format!("there is no user {name} ([plugin] user)"));
            }
            user
        }
        None => named("vizflyt").or_else(|| named("nobody")),
    };
    let Some(user) = user else {
        notes.push("the plugin runs as root, without root's powers".to_owned());
        return (None, true);
    };
    match unreadable(command, &user) {
        None => (Some((user.uid, user.gid)), false),
        Some(path) => {
            notes.push(format!(
                "the plugin runs as root, without root's powers: user {} cannot read {}",
                user.name,
                path.display()
            ));
            (None, true)
        }
    }
}

/// Returns the first file of the command that `user` cannot read.
fn unreadable(command: &[OsString], user: &User) -> Option<PathBuf> {
    let mut files: Vec<PathBuf> = Vec::new();
    for (index, part) in command.iter().enumerate() {
        let path = Path::new(part);
        if index == 0 && path.components().count() == 1 {
            files.extend(on_path(path));
        } else if path.exists() {
            files.push(path.to_owned());
        }
    }
    // Folders of Python packages.
    for name in ["PYTHONPATH", "VIRTUAL_ENV"] {
        let folders = std::env::var_os(name).unwrap_or_default();
        files.extend(std::env::split_paths(&folders).filter(|folder| folder.exists()));
    }
    files.extend(std::env::current_dir());
    let (uid, gid) = (user.uid, user.gid);
    let look = move || {
        // Opens the files with the permissions of that user; the setting is limited to this thread.
        nix::unistd::setfsgid(gid);
        nix::unistd::setfsuid(uid);
        files.into_iter().find(|file| File::open(file).is_err())
    };
    std::thread::spawn(look).join().ok().flatten()
}

/// Returns the path of a program in `PATH`.
fn on_path(program: &Path) -> Option<PathBuf> {
    let folders = std::env::var_os("PATH")?;
    std::env::split_paths(&folders).map(|folder| folder.join(program)).find(|path| path.is_file())
}

/// Returns the folders of the student's own code: folders and the folders of scripts on the command
/// line, and, if not graded, the working folder; never a complete home folder or the root folder.
fn own_folders(limits: &PluginLimits, command: &[OsString]) -> Vec<PathBuf> {
    let mut folders: Vec<PathBuf> = Vec::new();
    let working = std::env::current_dir().ok().filter(|_| !limits.graded);
    for folder in scripts(command).into_iter().chain(working) {
        let Ok(folder) = folder.canonicalize().or_else(|_| std::path::absolute(&folder)) else {
            continue;
        };
        if is_somebodys(&folder) && !folders.contains(&folder) {
            folders.push(folder);
        }
    }
    folders
}

/// Returns the folders, and the folders of scripts, on the command line.
fn scripts(command: &[OsString]) -> Vec<PathBuf> {
    let scripts = command.iter().map(Path::new).filter_map(|path| {
        if path.is_dir() {
            return Some(path.to_owned());
        }
        let is_script = path.extension().is_some_and(|extension| extension == "py");
        path.parent().filter(|_| is_script && path.is_file()).map(Path::to_owned)
    });
    scripts.collect()
}

/// Whether a folder is neither the root folder nor one that contains the home folder.
fn is_somebodys(folder: &Path) -> bool {
    let holds_home = std::env::home_dir().is_some_and(|home| home.starts_with(folder));
    !holds_home && folder.parent().is_some()
}

/// Makes the Landlock ruleset: allows writing in the plugin's folders, scratch space and compute devices,
/// and reading everything except hidden files.
///
/// A cell itself covers hidden files and makes scratch space, so the ruleset then omits both.
fn files(
    own: &[PathBuf],
    limits: &PluginLimits,
    in_cell: bool,
) -> Result<Option<OwnedFd>, RulesetError> {
    let own = if limits.graded { &[] } else { own };
    let mut places: Vec<PathBuf> = own.iter().chain(&limits.write).cloned().collect();
    places.extend((!in_cell).then(scratch).into_iter().flatten());
    let devices = ["null", "zero", "full", "tty", "pts", "ptmx", "dri", "kfd"];
    places.extend(devices.map(|device| Path::new("/dev").join(device)));
    // Graphics and video engines of NVIDIA's cards and of the Jetson: /dev/nvidia0, nvmap, nvhost-*.
    let nvidia = fs::read_dir("/dev").into_iter().flatten().flatten();
    let is_nvidia = |name: &OsString| name.to_string_lossy().starts_with("nv");
    places.extend(nvidia.filter(|entry| is_nvidia(&entry.file_name())).map(|entry| entry.path()));
    // Truncation needs ABI 3, scopes need ABI 6; older kernels apply the rest (best effort).
    let writing = AccessFs::from_write(ABI::V3);
    let rules = Ruleset::default()
        .set_compatibility(CompatLevel::BestEffort)
        .handle_access(writing)?
        .scope(Scope::from_all(ABI::V6))?;
    // Files in scratch space cannot be hidden: plugins must be able to read files that they create there later.
    let is_hideable = |path: &&PathBuf| !scratch().iter().any(|place| path.starts_with(place));
    let hidden: Vec<PathBuf> =
        limits.hide.iter().filter_map(|path| path.canonicalize().ok()).collect();
    let hidden: Vec<PathBuf> = hidden.iter().filter(is_hideable).cloned().collect();
    if hidden.is_empty() || in_cell {
        return Ok(rules.create()?.add_rules(path_beneath_rules(places, writing))?.into());
    }
    let reading = AccessFs::ReadFile | AccessFs::Execute;
    let rules = rules
        .handle_access(reading | AccessFs::ReadDir)?
        .create()?
        .add_rules(path_beneath_rules(places, writing))?
        // Names are not secret, and interpreters list folders to find modules.
        .add_rules(path_beneath_rules([Path::new("/")], AccessFs::ReadDir))?
        .add_rules(path_beneath_rules(all_but(Path::new("/"), &hidden), reading))?;
    Ok(rules.into())
}

/// Returns the folders in which plugins may always write: scratch space and shared memory.
fn scratch() -> [PathBuf; 3] {
    ["/tmp".into(), "/dev/shm".into(), std::env::temp_dir()]
}

/// Returns paths that together cover everything below `folder` except `hidden`. Landlock rules can only
/// allow, so the siblings of each folder on the path to a hidden one are listed.
fn all_but(folder: &Path, hidden: &[PathBuf]) -> Vec<PathBuf> {
    let mut listed = Vec::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if hidden.contains(&path) {
            continue;
        }
        if hidden.iter().any(|hidden| hidden.starts_with(&path)) {
            listed.extend(all_but(&path, hidden));
        } else {
            listed.push(path);
        }
    }
    listed
}

/// Whether the kernel can filter system calls and return a chosen error (seccomp(2)).
fn seccomp_is_there() -> bool {
    let action = libc::SECCOMP_RET_ERRNO;
    // SAFETY: SECCOMP_GET_ACTION_AVAIL reads four bytes, which live through the call.
    unsafe {
        libc::syscall(libc::SYS_seccomp, libc::SECCOMP_GET_ACTION_AVAIL, 0, &raw const action) == 0
    }
}

/// Makes the filters of system calls.
fn filters(
    limits: &PluginLimits,
    in_cell: bool,
) -> Result<Vec<BpfProgram>, seccompiler::BackendError> {
    let compile = |rules: BTreeMap<i64, Vec<SeccompRule>>, errno: i32| {
        let refuse = SeccompAction::Errno(errno.unsigned_abs());
        let arch = std::env::consts::ARCH.try_into()?;
        SeccompFilter::new(rules, SeccompAction::Allow, refuse, arch)?.try_into()
    };
    let when = |argument, operator, value: i32| {
        let value = u64::from(value.cast_unsigned());
        let condition = SeccompCondition::new(argument, SeccompCmpArgLen::Dword, operator, value)?;
        SeccompRule::new(vec![condition])
    };
    let mut refused: BTreeMap<i64, Vec<SeccompRule>> =
        FORBIDDEN.iter().map(|&call| (call, Vec::new())).collect();
    for (call, argument) in OF_OTHERS {
        refused.insert(call, vec![when(argument, SeccompCmpOp::Ne, 0)?]);
    }
    if !in_cell {
        // In a cell, all thread ids are the plugin's own, and libraries pin their threads to processors.
        let others = when(0, SeccompCmpOp::Ne, 0)?;
        refused.insert(libc::SYS_sched_setaffinity, vec![others]);
    }
    let namespaces = NAMESPACES
        .iter()
        .map(|&flag| when(0, SeccompCmpOp::MaskedEq(u64::from(flag.cast_unsigned())), flag));
    refused.insert(libc::SYS_clone, namespaces.collect::<Result<_, _>>()?);
    // A filter cannot read clone3's arguments; libraries fall back to clone(2).
    let hidden = BTreeMap::from([(libc::SYS_clone3, Vec::new())]);
    let mut filters = vec![compile(refused, libc::EPERM)?, compile(hidden, libc::ENOSYS)?];
    if !limits.network {
        // `socketpair` stays allowed: it connects only the plugin's own processes. All other sockets (autopilot,
        // desktop, services of other programs) fail as without a network.
        let rules = BTreeMap::from([(libc::SYS_socket, Vec::new())]);
        filters.push(compile(rules, libc::ENETUNREACH)?);
    }
    Ok(filters)
}

/// System calls that the plugin may use only on itself, with the index of the argument that selects the process (0:
/// itself).
const OF_OTHERS: [(i64, u8); 6] = [
    (libc::SYS_prlimit64, 0),
    (libc::SYS_setpriority, 1),
    (libc::SYS_ioprio_set, 1),
    (libc::SYS_sched_setscheduler, 0),
    (libc::SYS_sched_setparam, 0),
    (libc::SYS_sched_setattr, 0),
];

const NAMESPACES: [i32; 7] = [
    libc::CLONE_NEWNS,
    libc::CLONE_NEWCGROUP,
    libc::CLONE_NEWUTS,
    libc::CLONE_NEWIPC,
    libc::CLONE_NEWUSER,
    libc::CLONE_NEWPID,
    libc::CLONE_NEWNET,
];

/// System calls that no plugin needs: inspecting other processes, changing the system, and io_uring, whose
/// requests a filter cannot check.
const FORBIDDEN: [i64; 31] = [
    libc::SYS_ptrace,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_pidfd_getfd,
    libc::SYS_io_uring_setup,
    libc::SYS_io_uring_enter,
    libc::SYS_io_uring_register,
    libc::SYS_mount,
    libc::SYS_umount2,
    libc::SYS_pivot_root,
    libc::SYS_chroot,
    libc::SYS_move_mount,
    libc::SYS_fsopen,
    libc::SYS_open_tree,
    libc::SYS_unshare,
    libc::SYS_setns,
    libc::SYS_bpf,
    libc::SYS_perf_event_open,
    libc::SYS_kexec_load,
    libc::SYS_init_module,
    libc::SYS_finit_module,
    libc::SYS_delete_module,
    libc::SYS_reboot,
    libc::SYS_swapon,
    libc::SYS_settimeofday,
    libc::SYS_clock_settime,
    libc::SYS_clock_adjtime,
    libc::SYS_sethostname,
    libc::SYS_keyctl,
    libc::SYS_add_key,
    libc::SYS_userfaultfd,
];

/// Returns up to `cpus` processors without the first, which is left for the runtime; `None` if there is only one.
fn but_the_first(cpus: f64) -> Option<CpuSet> {
    let all = available_parallelism().map_or(1, std::num::NonZero::get);
    let own = nix::sched::sched_getaffinity(Pid::from_raw(0)).ok()?;
    let there = (0..CpuSet::count()).filter(|&cpu| own.is_set(cpu).unwrap_or(false));
    let most = (cpus.ceil() as usize).min(all.saturating_sub(1));
    let mut set = CpuSet::new();
    let mut any = false;
    for cpu in there.skip(1).take(most) {
        any |= set.set(cpu).is_ok();
    }
    any.then_some(set)
}

/// Returns the number of processes and threads of `uid`.
fn tasks_of(uid: Uid) -> u64 {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries
        .filter_map(|entry| {
            let status = fs::read_to_string(entry.path().join("status")).ok()?;
            let field = |name| status.lines().find_map(|line| line.strip_prefix(name));
            let owner: u32 = field("Uid:")?.split_whitespace().next()?.parse().ok()?;
            let threads = field("Threads:")?.trim().parse::<u64>().ok()?;
            (owner == uid.as_raw()).then_some(threads)
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_everything_except_hidden_files_once() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().canonicalize().unwrap();
        for name in ["a/keys", "a/code", "b", "c/deep/secret", "c/deep/open"] {
            fs::create_dir_all(root.join(name)).unwrap();
        }
        fs::write(root.join("a/plugin.py"), "x").unwrap();
        let hidden = ["a/keys", "c/deep/secret"].map(|name| root.join(name));
        let mut listed = all_but(&root, &hidden);
        listed.sort();
        let expected = ["a/code", "a/plugin.py", "b", "c/deep/open"].map(|name| root.join(name));
        assert_eq!(listed, expected);
        let mut all = all_but(&root, &[]);
        all.sort();
        assert_eq!(all, ["a", "b", "c"].map(|name| root.join(name)));
    }
}

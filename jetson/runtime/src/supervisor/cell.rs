//! A world of a plugin's own: namespaces in which there is the system, read-only, its own folder, and nobody else.
//!
//! | namespace | what the plugin finds |
//! |---|---|
//! | mount | the system and what it is shown, read-only but for its folders; all else is empty scratch space |
//! | PID | itself and what it starts; all of it ends with it |
//! | network, IPC, UTS | nobody to talk to |
//! | user | no power over any of these |
//!
//! ```text
//! runtime ── fork ──▶ keeper ── fork ──▶ init (1 in its world) ── fork ──▶ plugin
//! ```
//! The keeper is what the supervisor waits for; it ends as the plugin ended. Init makes the world, and reaps what the
//! plugin leaves behind. Neither runs anything else, and neither can be looked into: they hold a copy of the
//! runtime's memory.
//!
//! As root the mounts are made by root, and the plugin becomes another user; otherwise by the powers that a user namespace
//! gives over itself (user_namespaces(7)). Made between fork and exec, where nothing may be allocated: all is prepared
//! before.

#![allow(unsafe_code, reason = "system calls between fork and exec, where little is allowed")]

use std::ffi::{CStr, CString, OsStr};
use std::io;
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::ptr::null;

use landlock::{ABI, AccessFs};
use nix::libc;
use nix::unistd::{Gid, Pid, Uid, getegid, geteuid};

/// What a world is made of. Good for any number of plugins.
#[derive(Clone, Debug)]
pub(super) struct Cell {
    /// Whom the plugin becomes, if root makes it.
    user: Option<(Uid, Gid)>,
    network: bool,
    /// Covered by empty scratch space, and where each one's share of it lies at first.
    covered: Vec<(CString, CString)>,
    /// `tmpfs` options of all that space.
    scratch: CString,
    /// What is seen all the same, in order.
    shown: Vec<Shown>,
    /// What is not seen, wherever it lies; whether it is a folder.
    hidden: Vec<(CString, bool)>,
    /// Where the plugin starts, as a person's home that it is not shown: the way to it is there, empty.
    folder: Shown,
    /// For `/proc/self/uid_map` and `gid_map`.
    uid_map: CString,
    gid_map: CString,
}

/// A file or folder that the plugin sees at its own path.
#[derive(Clone, Debug)]
struct Shown {
    path: CString,
    is_folder: bool,
    is_writable: bool,
    /// Folders on the way to it, outermost first; missing where the way is covered.
    way: Vec<CString>,
}

/// `struct landlock_path_beneath_attr` of landlock_add_rule(2).
#[repr(C, packed)]
struct PathBeneath {
    allowed: u64,
    folder: RawFd,
}

/// What is asked of a world.
#[derive(Clone, Debug, Default)]
pub(super) struct Places {
    /// Seen, read-only, though they lie where all is covered.
    pub readable: Vec<PathBuf>,
    /// Seen, and written.
    pub writable: Vec<PathBuf>,
    /// Not seen, wherever they lie.
    pub hidden: Vec<PathBuf>,
    /// Where the plugin starts.
    pub folder: PathBuf,
}

/// The system's own folders: whoever is on this computer may read them. All others hold what is people's.
const SYSTEM: [&str; 14] = [
    "bin", "dev", "etc", "gnu", "lib", "lib32", "lib64", "libx32", "nix", "opt", "proc", "sbin",
    "sys", "usr",
];
/// What is shared within these.
const SHARED: [&str; 3] = ["/dev/shm", "/dev/mqueue", "/dev/pts"];

impl Cell {
    /// Prepares a world with `places` in it.
    ///
    /// `scratch_mb` is what all its scratch space holds at most. [MB]
    ///
    /// # Errors
    /// What this kernel refuses, in a sentence: it is tried.
    pub(super) fn prepare(
        user: Option<(Uid, Gid)>,
        network: bool,
        places: &Places,
        scratch_mb: u64,
    ) -> Result<Self, String> {
        let covered = covered();
        let mut shown: Vec<Shown> = Vec::new();
        for (paths, is_writable) in [(&places.readable, false), (&places.writable, true)] {
            for path in paths {
                // By its own name, and by that which the system gives it.
                let names = [std::path::absolute(path).ok(), path.canonicalize().ok()];
                for path in names.into_iter().flatten().filter(|path| path.exists()) {
                    let under = covered.iter().find(|covered| path.starts_with(covered));
                    let is_there = under.is_none() && !is_writable;
                    if is_there || under.is_some_and(|covered| *covered == path) {
                        continue;
                    }
                    shown.push(Shown::new(&path, under.map(PathBuf::as_path), is_writable)?);
                }
            }
        }
        // An outer folder must not hide an inner one that is shown differently, nor reading forbid writing.
        shown.sort_by_key(|shown| (shown.path.as_bytes().len(), shown.is_writable));
        shown.dedup_by(|later, earlier| {
            let is_same = later.path == earlier.path;
            earlier.is_writable |= is_same && later.is_writable;
            is_same
        });
        // Links within what is shown are there, and lead to what is shown by the name that the system gives it.
        let paths: Vec<PathBuf> = shown.iter().map(Shown::path).collect();
        shown.retain(|shown| {
            let path = shown.path();
            let is_within = paths.iter().any(|outer| path != *outer && path.starts_with(outer));
            !is_within || path.canonicalize().is_ok_and(|canonical| canonical == path)
        });
        let hidden = places.hidden.iter().filter_map(|path| path.canonicalize().ok());
        let hidden = hidden.filter(|path| {
            let is_within =
                |shown: &Shown| path.as_os_str().as_bytes().starts_with(shown.path.as_bytes());
            !covered.iter().any(|covered| path.starts_with(covered)) || shown.iter().any(is_within)
        });
        let hidden = hidden.map(|path| Ok((c_path(&path)?, path.is_dir())));
        let hidden = hidden.collect::<Result<Vec<_>, String>>()?;
        let (uid, gid) = user.unwrap_or((geteuid(), getegid()));
        let base = covered.first().cloned().unwrap_or_default();
        let share = |(index, path): (usize, &PathBuf)| {
            Ok((c_path(path)?, c_path(&base.join(index.to_string()))?))
        };
        let cell = Self {
            user,
            network,
            covered: covered.iter().enumerate().map(share).collect::<Result<_, String>>()?,
            scratch: c_text(&format!("mode=755,size={scratch_mb}m"))?,
            shown,
            hidden,
            folder: {
                let under = covered.iter().find(|covered| places.folder.starts_with(covered));
                Shown::new(&places.folder, under.map(PathBuf::as_path), false)?
            },
            uid_map: c_text(&format!("{uid} {uid} 1"))?,
            gid_map: c_text(&format!("{gid} {gid} 1"))?,
        };
        cell.try_out()?;
        Ok(cell)
    }

    /// Makes the world and enters it; returns in the process that is to become the plugin. Call it between fork and
    /// exec. The error's text says which step failed.
    pub(super) fn enter(&self) -> Result<(), Fault> {
        let root = self.user.is_some();
        let mut flags =
            libc::CLONE_NEWNS | libc::CLONE_NEWPID | libc::CLONE_NEWIPC | libc::CLONE_NEWUTS;
        if !self.network {
            flags |= libc::CLONE_NEWNET;
        }
        if !root {
            flags |= libc::CLONE_NEWUSER;
        }
        // SAFETY: numbers only.
        step("namespaces", unsafe { libc::unshare(flags) })?;
        if !root {
            // SAFETY: numbers only. A grader keeps itself to itself, and its child is so too until this is said: it
            // could not write its own map.
            step("a new user", unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 1, 0, 0, 0) })?;
            self.map_user()?;
        }
        die_with_parent()?;
        let mut pipe = [0; 2];
        // SAFETY: two descriptors are written to an array of two.
        step("a pipe", unsafe { libc::pipe2(pipe.as_mut_ptr(), libc::O_CLOEXEC) })?;
        if fork()? != 0 {
            keep(pipe[0]);
        }
        // Init, number 1 of its world.
        die_with_parent()?;
        self.make_mounts()?;
        if let Some((uid, gid)) = self.user {
            become_user(uid, gid)?;
            // SAFETY: numbers only. A change of user hides the process from itself until this is said.
            step("a new user", unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 1, 0, 0, 0) })?;
            // SAFETY: numbers only.
            step("a user namespace", unsafe { libc::unshare(libc::CLONE_NEWUSER) })?;
            self.map_user()?;
            die_with_parent()?;
        }
        let plugin = fork()?;
        if plugin != 0 {
            reap(plugin, pipe[1]);
        }
        die_with_parent()
    }

    /// Returns whom the plugin becomes, if root makes the world.
    pub(super) fn user(&self) -> Option<(Uid, Gid)> {
        self.user
    }

    /// Allows a Landlock ruleset's holder to write in the scratch space. In the plugin's process.
    pub(super) fn allow_scratch(&self, ruleset: RawFd) -> io::Result<()> {
        // SAFETY: asks for a version, by numbers.
        let version =
            unsafe { libc::syscall(libc::SYS_landlock_create_ruleset, null::<u8>(), 0usize, 1u32) };
        let abi = match version {
            ..=1 => ABI::V1,
            2 => ABI::V2,
            _ => ABI::V3,
        };
        for (path, _) in &self.covered {
            // SAFETY: a path that lives through the call.
            let folder = unsafe { libc::open(path.as_ptr(), libc::O_PATH | libc::O_CLOEXEC) };
            if folder < 0 {
                return Err(io::Error::last_os_error());
            }
            let rule = PathBeneath { allowed: AccessFs::from_write(abi).bits(), folder };
            // SAFETY: a ruleset, and a structure of the kernel's layout that lives through the call; then the folder
            // is closed.
            let done = unsafe {
                let done = libc::syscall(
                    libc::SYS_landlock_add_rule,
                    ruleset,
                    1u32,
                    &raw const rule,
                    0u32,
                );
                libc::close(folder);
                done
            };
            if done < 0 {
                return Err(io::Error::last_os_error());
            }
        }
        Ok(())
    }

    /// Covers what is hidden, and shows what is not. As init, with powers over the mounts.
    fn make_mounts(&self) -> Result<(), Fault> {
        let private = libc::MS_REC | libc::MS_PRIVATE;
        mount("mounts of its own", None, c"/", None, private, None)?;
        let mut trees = [-1; MAX_PLACES];
        for (tree, shown) in trees.iter_mut().zip(&self.shown) {
            *tree = clone_tree(&shown.path)?;
        }
        let read_only = libc::MOUNT_ATTR_RDONLY | libc::MOUNT_ATTR_NOSUID;
        set_attributes(libc::AT_FDCWD, c"/", libc::AT_RECURSIVE, read_only)?;
        self.cover()?;
        for (&tree, shown) in trees.iter().zip(&self.shown) {
            let attributes = if shown.is_writable {
                libc::MOUNT_ATTR_NOSUID | libc::MOUNT_ATTR_NODEV
            } else {
                read_only
            };
            set_attributes(tree, c"", libc::AT_EMPTY_PATH | libc::AT_RECURSIVE, attributes)?;
            shown.make_place()?;
            move_mount(tree, &shown.path)?;
        }
        for (path, is_folder) in &self.hidden {
            if *is_folder {
                let empty = libc::MS_NOSUID | libc::MS_NODEV | libc::MS_RDONLY;
                mount(
                    "a cover",
                    Some(c"hidden"),
                    path,
                    Some(c"tmpfs"),
                    empty,
                    Some(c"mode=0,size=4k"),
                )?;
            } else {
                mount("a cover", Some(c"/dev/null"), path, None, libc::MS_BIND, None)?;
            }
        }
        let hardened = libc::MS_NOSUID | libc::MS_NODEV | libc::MS_NOEXEC;
        mount("/proc of its own", Some(c"proc"), c"/proc", Some(c"proc"), hardened, None)?;
        self.folder.make_place()?;
        // SAFETY: a path that lives through the call. The former folder is that of the world outside.
        step("its folder", unsafe { libc::chdir(self.folder.path.as_ptr()) })
    }

    /// Covers what is people's by shares of one scratch space, so that together they hold no more than it does.
    fn cover(&self) -> Result<(), Fault> {
        let what = "scratch space";
        let Some((base, _)) = self.covered.first() else { return Ok(()) };
        let flags = libc::MS_NOSUID | libc::MS_NODEV;
        mount(what, Some(c"scratch"), base, Some(c"tmpfs"), flags, Some(&self.scratch))?;
        let mut shares = [-1; MAX_PLACES];
        for (tree, (_, share)) in shares.iter_mut().zip(&self.covered) {
            make_folder(share)?;
            // SAFETY: a path that lives through the call.
            step(what, unsafe { libc::chmod(share.as_ptr(), 0o1777) })?;
            *tree = clone_tree(share)?;
        }
        // SAFETY: a path that lives through the call. The shares hold what they are part of.
        step(what, unsafe { libc::umount2(base.as_ptr(), libc::MNT_DETACH) })?;
        for (&tree, (path, _)) in shares.iter().zip(&self.covered) {
            move_mount(tree, path)?;
        }
        Ok(())
    }

    fn map_user(&self) -> Result<(), Fault> {
        write_file(c"/proc/self/setgroups", c"deny")?;
        write_file(c"/proc/self/uid_map", &self.uid_map)?;
        write_file(c"/proc/self/gid_map", &self.gid_map)
    }

    /// Makes the world once, for nobody.
    fn try_out(&self) -> Result<(), String> {
        if self.shown.len().max(self.covered.len()) > MAX_PLACES {
            return Err(format!("there are more than {MAX_PLACES} folders to cover or to show"));
        }
        let (reader, writer) = io::pipe().map_err(|error| error.to_string())?;
        let number = writer.as_raw_fd();
        // SAFETY: the child makes system calls only, on what was prepared, and exits.
        let child = unsafe { libc::fork() };
        if child == 0 {
            match self.enter() {
                Ok(()) => {}
                Err((step, error)) => {
                    let code = error.raw_os_error().unwrap_or(0).to_le_bytes();
                    for bytes in [&code[..], step.as_bytes()] {
                        // SAFETY: bytes that live through the call, to a pipe that is open.
                        unsafe { libc::write(number, bytes.as_ptr().cast(), bytes.len()) };
                    }
                }
            }
            // SAFETY: ends this process, and nothing else.
            unsafe { libc::_exit(0) };
        }
        drop(writer);
        if child < 0 {
            return Err(io::Error::last_os_error().to_string());
        }
        let mut report = Vec::new();
        let read = io::Read::read_to_end(&mut &reader, &mut report);
        let _ = nix::sys::wait::waitpid(Pid::from_raw(child), None);
        read.map_err(|error| error.to_string())?;
        match report.split_first_chunk::<4>() {
            None => Ok(()),
            Some((code, step)) => {
                let error = io::Error::from_raw_os_error(i32::from_le_bytes(*code));
                Err(format!("{}: {error}", String::from_utf8_lossy(step)))
            }
        }
    }
}

impl Shown {
    fn new(path: &Path, under: Option<&Path>, is_writable: bool) -> Result<Self, String> {
        let missing = |folder: &&Path| under.is_some_and(|covered| folder.starts_with(covered));
        let mut way: Vec<&Path> = path.ancestors().skip(1).take_while(missing).collect();
        way.reverse();
        Ok(Self {
            path: c_path(path)?,
            is_folder: path.is_dir(),
            is_writable,
            way: way.into_iter().map(c_path).collect::<Result<_, _>>()?,
        })
    }

    fn path(&self) -> PathBuf {
        PathBuf::from(OsStr::from_bytes(self.path.as_bytes()))
    }

    /// Makes the way to it, and what it is mounted on, where these were covered.
    fn make_place(&self) -> Result<(), Fault> {
        for folder in &self.way {
            make_folder(folder)?;
        }
        if self.way.is_empty() {
            return Ok(());
        }
        if self.is_folder {
            return make_folder(&self.path);
        }
        // SAFETY: a path that lives through the call.
        let file =
            unsafe { libc::open(self.path.as_ptr(), libc::O_CREAT | libc::O_CLOEXEC, 0o444) };
        // Then it is there, or a link leads to where it is.
        if file < 0 {
            return Ok(());
        }
        // SAFETY: ours, and not used any more.
        unsafe { libc::close(file) };
        Ok(())
    }
}

/// Returns the folders that hold what is people's: those at the root that are not the system's, what is shared, and
/// homes and scratch space wherever they are.
fn covered() -> Vec<PathBuf> {
    let top = std::fs::read_dir("/").into_iter().flatten().flatten();
    let top = top.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    let top = top.filter(|entry| !SYSTEM.iter().any(|name| entry.file_name() == *name));
    let mut all: Vec<PathBuf> = top.map(|entry| entry.path()).collect();
    let others = SHARED.iter().map(PathBuf::from).chain(std::env::home_dir());
    let others = others.chain([std::env::temp_dir()]).filter_map(|path| path.canonicalize().ok());
    all.extend(others.filter(|path| path.is_dir() && path.parent().is_some()));
    all.sort();
    // What is within another one is covered with it, and comes after it.
    all.dedup_by(|inner, outer| inner.starts_with(&*outer));
    all
}

/// A step that failed, and how the system put it.
type Fault = (&'static str, io::Error);

fn step(what: &'static str, result: i32) -> Result<(), Fault> {
    if result < 0 { Err((what, io::Error::last_os_error())) } else { Ok(()) }
}

/// Forks; 0 in the child.
fn fork() -> Result<i32, Fault> {
    // SAFETY: as vfork's, the child goes on with system calls only.
    let child = unsafe { libc::fork() };
    step("another process", child)?;
    Ok(child)
}

/// Ends this process when its parent ends. A change of user or of powers takes that back.
fn die_with_parent() -> Result<(), Fault> {
    // SAFETY: numbers only.
    step("an end with its parent", unsafe {
        libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL, 0, 0, 0)
    })
}

/// Lets nobody look into this process, and closes all files but one, which becomes number 3.
fn shut(kept: RawFd) {
    // SAFETY: numbers only; what is closed is this copy of the process's alone, and nothing uses it any more.
    unsafe {
        libc::prctl(libc::PR_SET_DUMPABLE, 0, 0, 0, 0);
        libc::dup2(kept, 3);
        libc::syscall(libc::SYS_close_range, 4, u32::MAX, 0);
        libc::close(0);
        libc::close(1);
        libc::close(2);
        libc::signal(libc::SIGTERM, libc::SIG_IGN);
        libc::signal(libc::SIGINT, libc::SIG_IGN);
    }
}

/// The keeper: waits for init's word of how the plugin ended, and ends so itself.
fn keep(report: RawFd) -> ! {
    shut(report);
    let mut status = 0i32;
    // SAFETY: four bytes are read into an integer; then this process ends, by itself or by the plugin's signal.
    unsafe {
        let read = loop {
            let read = libc::read(3, (&raw mut status).cast(), 4);
            if read >= 0 || *libc::__errno_location() != libc::EINTR {
                break read;
            }
        };
        // Without a word, somebody has killed init.
        let signal = if read != 4 {
            libc::SIGKILL
        } else if libc::WIFSIGNALED(status) {
            libc::WTERMSIG(status)
        } else {
            libc::_exit(libc::WEXITSTATUS(status));
        };
        libc::setrlimit(libc::RLIMIT_CORE, &libc::rlimit { rlim_cur: 0, rlim_max: 0 });
        libc::signal(signal, libc::SIG_DFL);
        libc::kill(libc::getpid(), signal);
        libc::_exit(128 + signal);
    }
}

/// Init: reaps whatever ends, until the plugin does; its own end is that of all that are left.
fn reap(plugin: i32, report: RawFd) -> ! {
    shut(report);
    let mut status = 0i32;
    // SAFETY: integers that live through the calls; then this process ends.
    unsafe {
        loop {
            let ended = libc::wait(&raw mut status);
            if ended == plugin || ended < 0 && *libc::__errno_location() == libc::ECHILD {
                break;
            }
        }
        libc::write(3, (&raw const status).cast(), 4);
        libc::_exit(0);
    }
}

fn become_user(uid: Uid, gid: Gid) -> Result<(), Fault> {
    let became = nix::unistd::setgroups(&[])
        .and_then(|()| nix::unistd::setresgid(gid, gid, gid))
        .and_then(|()| nix::unistd::setresuid(uid, uid, uid));
    became.map_err(|error| ("another user", error.into()))
}

fn mount(
    what: &'static str,
    source: Option<&CStr>,
    target: &CStr,
    kind: Option<&CStr>,
    flags: libc::c_ulong,
    options: Option<&CStr>,
) -> Result<(), Fault> {
    let pointer = |text: Option<&CStr>| text.map_or(null(), CStr::as_ptr);
    // SAFETY: texts that live through the call, or null where mount(2) allows it.
    step(what, unsafe {
        libc::mount(pointer(source), target.as_ptr(), pointer(kind), flags, pointer(options).cast())
    })
}

/// Returns a copy of the mounts at `path`, attached nowhere.
fn clone_tree(path: &CStr) -> Result<RawFd, Fault> {
    let flags = libc::OPEN_TREE_CLONE | libc::OPEN_TREE_CLOEXEC | libc::AT_RECURSIVE as u32;
    // SAFETY: a path that lives through the call.
    let tree = unsafe { libc::syscall(libc::SYS_open_tree, libc::AT_FDCWD, path.as_ptr(), flags) };
    step("a folder to show", tree as i32)?;
    Ok(tree as RawFd)
}

fn set_attributes(
    folder: RawFd,
    path: &CStr,
    flags: libc::c_int,
    attributes: u64,
) -> Result<(), Fault> {
    let attributes =
        libc::mount_attr { attr_set: attributes, attr_clr: 0, propagation: 0, userns_fd: 0 };
    // SAFETY: a path and a structure that live through the call, with its size.
    let done = unsafe {
        libc::syscall(
            libc::SYS_mount_setattr,
            folder,
            path.as_ptr(),
            flags,
            &raw const attributes,
            size_of::<libc::mount_attr>(),
        )
    };
    step("a read-only system", done as i32)
}

fn move_mount(tree: RawFd, path: &CStr) -> Result<(), Fault> {
    let flags = libc::MOVE_MOUNT_F_EMPTY_PATH;
    // SAFETY: paths that live through the call.
    let done = unsafe {
        libc::syscall(
            libc::SYS_move_mount,
            tree,
            c"".as_ptr(),
            libc::AT_FDCWD,
            path.as_ptr(),
            flags,
        )
    };
    step("a folder to show", done as i32)
}

fn make_folder(path: &CStr) -> Result<(), Fault> {
    // SAFETY: a path that lives through the call.
    match step("a folder on the way", unsafe { libc::mkdir(path.as_ptr(), 0o755) }) {
        // It is there, or a link leads to where it is.
        Err((_, error)) if matches!(error.raw_os_error(), Some(libc::EEXIST | libc::EROFS)) => {
            Ok(())
        }
        result => result,
    }
}

fn write_file(path: &CStr, text: &CStr) -> Result<(), Fault> {
    let what = "a map of users";
    // SAFETY: a path that lives through the call.
    let file = unsafe { libc::open(path.as_ptr(), libc::O_WRONLY | libc::O_CLOEXEC) };
    step(what, file)?;
    let bytes = text.to_bytes();
    // SAFETY: bytes that live through the call, to a file that is open; then it is closed.
    let written = unsafe {
        let written = libc::write(file, bytes.as_ptr().cast(), bytes.len());
        let error = *libc::__errno_location();
        libc::close(file);
        *libc::__errno_location() = error;
        written
    };
    step(what, written as i32)
}

fn c_path(path: &Path) -> Result<CString, String> {
    CString::new(path.as_os_str().as_bytes()).map_err(|error| error.to_string())
}

fn c_text(text: &str) -> Result<CString, String> {
    CString::new(text).map_err(|error| error.to_string())
}

/// Folders and files that are shown, or covered, at most.
const MAX_PLACES: usize = 256;

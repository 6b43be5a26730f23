//! Cell of a plugin: Linux namespaces that contain only the read-only system and the plugin's own folder.
//!
//! | namespace | contents |
//! |---|---|
//! | mount | the system and shown files, read-only except for writable folders; all others are empty scratch space |
//! | PID | the plugin and its descendants; all of them end with the plugin |
//! | network, IPC, UTS | no connection to other programs |
//! | user | no capabilities in the other namespaces |
//!
//! ```text
//! runtime ── fork ──▶ keeper ── fork ──▶ init (PID 1 of the cell) ── fork ──▶ plugin
//! ```
//! The supervisor waits for the keeper, which ends with the plugin's exit status or signal. Init makes the mounts, and
//! reaps the plugin's descendants. Both hold a copy of the runtime's memory and command line, so they run no other program
//! and cannot be inspected: they are not dumpable, and the cell's `/proc` shows only processes that the reader may trace.
//!
//! If the runtime is root, root makes the mounts and the plugin becomes another user. Otherwise a user namespace gives
//! the necessary capabilities (user_namespaces(7)). The cell is made between fork and exec, where allocation is not
//! allowed, so everything is prepared before.

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

/// Prepared contents of a cell, for any number of starts.
#[derive(Clone, Debug)]
pub(super) struct Cell {
    /// The plugin's user, if the runtime is root.
    user: Option<(Uid, Gid)>,
    network: bool,
    /// Folders covered by empty scratch space, each with the initial path of its part of that space.
    covered: Vec<(CString, CString)>,
    /// `tmpfs` options of the scratch space.
    scratch: CString,
    /// Files and folders shown inside covered folders, or writable, in the order of mounting.
    shown: Vec<Shown>,
    /// Hidden paths, and whether each is a folder.
    hidden: Vec<(CString, bool)>,
    /// Folder in which the plugin starts. If it is covered, for example a home folder, it exists but is empty.
    folder: Shown,
    /// Content of `/proc/self/uid_map`, and below of `gid_map`.
    uid_map: CString,
    gid_map: CString,
}

/// A file or folder that the plugin sees at its own path.
#[derive(Clone, Debug)]
struct Shown {
    path: CString,
    /// Path of this file or folder without links.
    source: CString,
    is_folder: bool,
    is_writable: bool,
    /// Covered parent folders, outermost first; they must be created before the mount.
    way: Vec<CString>,
}

/// `struct landlock_path_beneath_attr` of landlock_add_rule(2).
#[repr(C, packed)]
struct PathBeneath {
    allowed: u64,
    folder: RawFd,
}

/// Requested contents of a cell.
#[derive(Clone, Debug, Default)]
pub(super) struct Places {
    /// Paths shown read-only, also inside covered folders.
    pub readable: Vec<PathBuf>,
    /// Paths shown writable.
    pub writable: Vec<PathBuf>,
    /// Hidden paths, also inside shown folders.
    pub hidden: Vec<PathBuf>,
    /// Folders that student code may change, each with its canonical path. A path in them is not shown if links lead
    /// it out of them.
    pub untrusted: Vec<(PathBuf, PathBuf)>,
    /// Folder in which the plugin starts.
    pub folder: PathBuf,
}

/// Folders of the system in `/`, which every user of this computer may read. All others may hold private data.
const SYSTEM: [&str; 14] = [
    "bin", "dev", "etc", "gnu", "lib", "lib32", "lib64", "libx32", "nix", "opt", "proc", "sbin",
    "sys", "usr",
];
/// Folders inside [`SYSTEM`] that programs share.
const SHARED: [&str; 3] = ["/dev/shm", "/dev/mqueue", "/dev/pts"];

impl Cell {
    /// Prepares a cell with `places`, and makes it once as a test.
    ///
    /// `scratch_mb`: maximum size of all scratch space together. [MB]
    ///
    /// # Errors
    /// The step that this kernel rejects, as a sentence.
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
                let (Ok(path), Ok(source)) = (std::path::absolute(path), path.canonicalize())
                else {
                    continue;
                };
                if places.untrusted.iter().any(|(folder, canonical)| {
                    let is_in = path.starts_with(folder) || path.starts_with(canonical);
                    is_in && !source.starts_with(canonical)
                }) {
                    continue;
                }
                // By the given path, and by the canonical path.
                for path in [&path, &source] {
                    let under = covered.iter().find(|covered| path.starts_with(covered));
                    let is_there = under.is_none() && !is_writable;
                    if is_there || under.is_some_and(|covered| covered == path) {
                        continue;
                    }
                    let under = under.map(PathBuf::as_path);
                    shown.push(Shown::new(path, &source, under, is_writable)?);
                }
            }
        }
        // Outer folders first, so that they do not hide inner ones. A path in both lists is writable.
        shown.sort_by_key(|shown| (shown.path.as_bytes().len(), shown.is_writable));
        shown.dedup_by(|later, earlier| {
            let is_same = later.path == earlier.path;
            earlier.is_writable |= is_same && later.is_writable;
            is_same
        });
        // Links inside shown folders need no mount: they exist there, and their targets are shown by their canonical
        // paths.
        let paths: Vec<PathBuf> = shown.iter().map(Shown::path).collect();
        shown.retain(|shown| {
            let path = shown.path();
            let is_within = paths.iter().any(|outer| path != *outer && path.starts_with(outer));
            !is_within || shown.path == shown.source
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
                Shown::new(&places.folder, &places.folder, under.map(PathBuf::as_path), false)?
            },
            uid_map: c_text(&format!("{uid} {uid} 1"))?,
            gid_map: c_text(&format!("{gid} {gid} 1"))?,
        };
        cell.try_out()?;
        Ok(cell)
    }

    /// Makes the cell and enters it; returns in the process that becomes the plugin. Call it between fork and exec.
    /// The error contains the name of the failed step.
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
            // SAFETY: numbers only. A grader is not dumpable, and its child inherits that; the child could then not
            // write its `uid_map`.
            step("a new user", unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 1, 0, 0, 0) })?;
            self.map_user()?;
        }
        die_with_parent()?;
        let mut pipe = [0; 2];
        // SAFETY: writes two descriptors to an array of two.
        step("a pipe", unsafe { libc::pipe2(pipe.as_mut_ptr(), libc::O_CLOEXEC) })?;
        if fork()? != 0 {
            keep(pipe[0]);
        }
        // Init, PID 1 of the cell.
        die_with_parent()?;
        self.make_mounts()?;
        if let Some((uid, gid)) = self.user {
            become_user(uid, gid)?;
            // SAFETY: numbers only. A change of user clears the dumpable flag, without which the process cannot write
            // its `uid_map`.
            step("a new user", unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 1, 0, 0, 0) })?;
            // SAFETY: numbers only.
            step("a user namespace", unsafe { libc::unshare(libc::CLONE_NEWUSER) })?;
            self.map_user()?;
            die_with_parent()?;
        }
        // Before the plugin exists, so that it never sees a dumpable init. Its own exec makes it dumpable again.
        // SAFETY: numbers only.
        step("a hidden init", unsafe { libc::prctl(libc::PR_SET_DUMPABLE, 0, 0, 0, 0) })?;
        let plugin = fork()?;
        if plugin != 0 {
            reap(plugin, pipe[1]);
        }
        die_with_parent()
    }

    /// Returns the plugin's user, if the runtime is root.
    pub(super) fn user(&self) -> Option<(Uid, Gid)> {
        self.user
    }

    /// Adds the scratch space to a Landlock ruleset as writable. Call it in the plugin's process.
    pub(super) fn allow_scratch(&self, ruleset: RawFd) -> io::Result<()> {
        // SAFETY: numbers and a null pointer; returns the ABI version.
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
            // SAFETY: a ruleset, and a structure in the kernel's layout that lives through the call; then closes the
            // folder.
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

    /// Makes the mounts of the cell. Call it in init, with capabilities over the mount namespace.
    fn make_mounts(&self) -> Result<(), Fault> {
        let private = libc::MS_REC | libc::MS_PRIVATE;
        mount("private mounts", None, c"/", None, private, None)?;
        let mut trees = [-1; MAX_PLACES];
        for (tree, shown) in trees.iter_mut().zip(&self.shown) {
            *tree = shown.clone_source()?;
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
        // Mode 4 hides processes that the reader may not trace, regardless of user and group. `cmdline` and `status` of
        // init would otherwise be readable.
        let options = Some(c"hidepid=4");
        mount("a private /proc", Some(c"proc"), c"/proc", Some(c"proc"), hardened, options)?;
        self.folder.make_place()?;
        // SAFETY: a path that lives through the call. Leaves the working folder, which is outside the cell.
        step("its folder", unsafe { libc::chdir(self.folder.path.as_ptr()) })
    }

    /// Covers private folders with parts of one scratch space, so that its size limits them together.
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
        // SAFETY: a path that lives through the call. The clones keep the file system alive.
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

    /// Makes the cell once in a child process that exits at once.
    fn try_out(&self) -> Result<(), String> {
        if self.shown.len().max(self.covered.len()) > MAX_PLACES {
            return Err(format!(
                "there are more than {MAX_PLACES} folders to cover or to show; list fewer in read and write of [plugin]"
            ));
        }
        let (reader, writer) = io::pipe().map_err(|error| error.to_string())?;
        let number = writer.as_raw_fd();
        // SAFETY: the child makes only system calls with prepared data, and exits.
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
            // SAFETY: ends this process without running destructors.
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
    fn new(
        path: &Path,
        source: &Path,
        under: Option<&Path>,
        is_writable: bool,
    ) -> Result<Self, String> {
        let missing = |folder: &&Path| under.is_some_and(|covered| folder.starts_with(covered));
        let mut way: Vec<&Path> = path.ancestors().skip(1).take_while(missing).collect();
        way.reverse();
        Ok(Self {
            path: c_path(path)?,
            source: c_path(source)?,
            is_folder: source.is_dir(),
            is_writable,
            way: way.into_iter().map(c_path).collect::<Result<_, _>>()?,
        })
    }

    fn path(&self) -> PathBuf {
        PathBuf::from(OsStr::from_bytes(self.path.as_bytes()))
    }

    /// Returns a detached copy of the mounts at the source. Fails if student code has put a link on its path since the
    /// cell was prepared.
    fn clone_source(&self) -> Result<RawFd, Fault> {
        // SAFETY: a structure of numbers, for which zeros are valid.
        let mut how: libc::open_how = unsafe { std::mem::zeroed() };
        how.flags = (libc::O_PATH | libc::O_CLOEXEC | libc::O_NOFOLLOW) as u64;
        how.resolve = libc::RESOLVE_NO_SYMLINKS;
        let (path, size) = (self.source.as_ptr(), size_of::<libc::open_how>());
        // SAFETY: a path and a structure that live through the call, with its size.
        let file =
            unsafe { libc::syscall(libc::SYS_openat2, libc::AT_FDCWD, path, &raw const how, size) };
        step("a folder to show", file as i32)?;
        let tree = clone_at(file as RawFd, c"");
        // SAFETY: opened above, and not used any more.
        unsafe { libc::close(file as RawFd) };
        tree
    }

    /// Creates the parent folders and the mount point, if they are covered.
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
        // The file exists already, or a link leads to it.
        if file < 0 {
            return Ok(());
        }
        // SAFETY: opened above, and not used any more.
        unsafe { libc::close(file) };
        Ok(())
    }
}

/// Returns the folders to cover: those in `/` that are not the system's, those in [`SHARED`], the home folder, and the
/// folder of temporary files.
fn covered() -> Vec<PathBuf> {
    let top = std::fs::read_dir("/").into_iter().flatten().flatten();
    let top = top.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    let top = top.filter(|entry| !SYSTEM.iter().any(|name| entry.file_name() == *name));
    let mut all: Vec<PathBuf> = top.map(|entry| entry.path()).collect();
    let others = SHARED.iter().map(PathBuf::from).chain(std::env::home_dir());
    let others = others.chain([std::env::temp_dir()]).filter_map(|path| path.canonicalize().ok());
    all.extend(others.filter(|path| path.is_dir() && path.parent().is_some()));
    all.sort();
    // Removes folders inside other folders; sorting has put them directly after those.
    all.dedup_by(|inner, outer| inner.starts_with(&*outer));
    all
}

/// A failed step and its system error.
type Fault = (&'static str, io::Error);

fn step(what: &'static str, result: i32) -> Result<(), Fault> {
    if result < 0 { Err((what, io::Error::last_os_error())) } else { Ok(()) }
}

/// Forks; 0 in the child.
fn fork() -> Result<i32, Fault> {
    // SAFETY: the child makes only system calls, as after vfork.
    let child = unsafe { libc::fork() };
    step("another process", child)?;
    Ok(child)
}

/// Kills this process when its parent ends. A change of user or of capabilities clears the setting.
fn die_with_parent() -> Result<(), Fault> {
    // SAFETY: numbers only.
    step("a parent-death signal", unsafe {
        libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL, 0, 0, 0)
    })
}

/// Protects this process against inspection, and closes all files except `kept`, which becomes descriptor 3.
fn shut(kept: RawFd) {
    // SAFETY: numbers only; the closed descriptors belong only to this process, which does not use them any more.
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

/// Keeper: waits for the plugin's wait status from init, and ends with the same exit status or signal.
fn keep(report: RawFd) -> ! {
    shut(report);
    let mut status = 0i32;
    // SAFETY: reads four bytes into an integer; then this process ends, by itself or by the plugin's signal.
    unsafe {
        let read = loop {
            let read = libc::read(3, (&raw mut status).cast(), 4);
            if read >= 0 || *libc::__errno_location() != libc::EINTR {
                break read;
            }
        };
        // Without a status, init was killed.
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

/// Init: reaps processes until the plugin ends; the kernel then kills the remaining processes of the cell.
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
    // SAFETY: strings that live through the call, or null where mount(2) allows it.
    step(what, unsafe {
        libc::mount(pointer(source), target.as_ptr(), pointer(kind), flags, pointer(options).cast())
    })
}

/// Returns a detached copy of the mounts at `path`.
fn clone_tree(path: &CStr) -> Result<RawFd, Fault> {
    clone_at(libc::AT_FDCWD, path)
}

/// Same as [`clone_tree`], relative to a folder; an empty path is the folder itself.
fn clone_at(folder: RawFd, path: &CStr) -> Result<RawFd, Fault> {
    let empty = libc::AT_EMPTY_PATH | libc::AT_RECURSIVE;
    let flags = libc::OPEN_TREE_CLONE | libc::OPEN_TREE_CLOEXEC | empty as u32;
    // SAFETY: a path that lives through the call.
    let tree = unsafe { libc::syscall(libc::SYS_open_tree, folder, path.as_ptr(), flags) };
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
        // The folder exists already, or a link leads to it.
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
    // SAFETY: bytes that live through the call, to a file that is open; then closes it.
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

/// Maximum number of shown or covered paths.
const MAX_PLACES: usize = 256;

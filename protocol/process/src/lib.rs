//! Functions that every program needs as a process: print lines, stop on signals, open a page in a browser.
//!
//! ```text
//! print_line, print_fmt!, print_error   print lines; no panic if the reader has ended
//! never_wait_for_readers                output through queues, for commands that fly or serve
//! on_interrupt                          calls back on each SIGINT and SIGTERM
//! stop_flag                             flag set by these signals, or when standard input ends (end of the parent)
//! lock                                  locks a mutex, even after a thread has panicked
//! descriptors                           limit of file descriptors, and a reserve
//! monotonic_ns                          clock, which tests can pause
//! processor_seconds                     processor time of this process
//! ```

mod clock;
pub mod descriptors;
mod lock;
mod output;
mod usage;

use std::io::Read;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};
pub use clock::monotonic_ns;
pub use lock::lock;
pub use output::{
    LogWriter, OutputStream, finish_output, never_wait_for_readers, print_error, print_line,
    print_text,
};
use tokio::signal::unix::{SignalKind, signal};
pub use usage::processor_seconds;

/// Prints a line, formatted as by `println!`. See [`print_line`].
#[macro_export]
macro_rules! print_fmt {
    ($($text:tt)*) => { $crate::print_line(format_args!($($text)*)) };
}

/// Calls `notice` on each SIGINT and SIGTERM, on a separate thread, until it returns false. The handlers are installed
/// when this function returns.
///
/// # Errors
/// Returns an error if the handlers cannot be installed.
pub fn on_interrupt(mut notice: impl FnMut() -> bool + Send + 'static) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot watch for signals")?;
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot watch for SIGINT")?;
    let mut terminate = signal(SignalKind::terminate()).context("cannot watch for SIGTERM")?;
    drop(guard);
    let wait = move || {
        runtime.block_on(async {
            loop {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                }
                if !notice() {
                    return;
                }
            }
        });
    };
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(wait)
        .context("cannot start the thread that waits for signals")?;
    Ok(())
}

/// Calls `notice` once, on a separate thread, when standard input ends: the parent process has ended.
///
/// # Errors
/// Returns an error if the thread cannot be started.
pub fn on_orphaned(notice: impl FnOnce() + Send + 'static) -> Result<()> {
    let wait = move || {
        let mut buffer = [0; 256];
        let mut input = std::io::stdin().lock();
        // Received bytes are ignored. An error counts as the end.
        while matches!(input.read(&mut buffer), Ok(length) if length > 0) {}
        notice();
    };
    // Never joined: a blocking read cannot be cancelled.
    std::thread::Builder::new()
        .name("lifeline".to_owned())
        .spawn(wait)
        .context("cannot start the thread that watches standard input")?;
    Ok(())
}

/// Returns a flag that is set on SIGINT and SIGTERM, and with `lifeline` also at the end of standard input.
///
/// # Errors
/// Returns an error if the handlers cannot be installed.
pub fn stop_flag(lifeline: bool) -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    on_interrupt(move || {
        set.store(true, Ordering::Relaxed);
        false
    })?;
    if lifeline {
        let set = Arc::clone(&flag);
        on_orphaned(move || set.store(true, Ordering::Relaxed))?;
    }
    Ok(flag)
}

/// Opens a page in the browser. Without a desktop, prints a hint instead.
pub fn open_browser(url: &str) {
    let opener = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let spawned = std::process::Command::new(opener)
        .arg(url)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    if spawned.is_err() {
        print_line("            open it in a browser");
    }
}

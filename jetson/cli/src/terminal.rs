//! What people see outside a flight: lines on standard output, and the page in a browser; and how they end
//! a command.

use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};
pub(crate) use vizflyt_runtime::control::print_line;
use vizflyt_server::render::RendererInfo;

/// Prints a line on standard error; unlike `eprintln!` it does not panic when nobody reads any more.
pub(crate) fn print_error(line: impl std::fmt::Display) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

/// Prints a line for people, formatted as by `println!`; see [`print_line`].
macro_rules! print_fmt {
    ($($text:tt)*) => { $crate::terminal::print_line(format_args!($($text)*)) };
}
pub(crate) use print_fmt;

/// Calls `notice` on SIGINT and SIGTERM, until it returns false.
pub(crate) fn on_interrupt(mut notice: impl FnMut() -> bool + Send + 'static) -> Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot watch for signals")?;
    // Installed before this returns, so that no signal falls between.
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot watch for SIGINT")?;
    let mut terminate = signal(SignalKind::terminate()).context("cannot watch for SIGTERM")?;
    drop(guard);
    std::thread::spawn(move || {
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
    });
    Ok(())
}

/// Returns a flag that is set on SIGINT and SIGTERM, and with `lifeline` by the end of standard input: then the
/// parent has gone.
pub(crate) fn stop_flag(lifeline: bool) -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    on_interrupt(move || {
        set.store(true, Ordering::Relaxed);
        false
    })?;
    if lifeline {
        let set = Arc::clone(&flag);
        std::thread::spawn(move || {
            let mut buffer = [0; 256];
            // Bytes mean nothing; the end, or an error, means that the parent has gone.
            while matches!(std::io::stdin().read(&mut buffer), Ok(length) if length > 0) {}
            set.store(true, Ordering::Relaxed);
        });
    }
    Ok(flag)
}

/// Returns what tells of a page that answers: what draws it and its address; and opens it, if that is not to be `quiet`.
pub(crate) fn show_page(quiet: bool) -> impl FnOnce(&str, &RendererInfo) {
    move |url, renderer| {
        print_line(format!("renderer    {} ({})", renderer.name, renderer.reason));
        print_line(format!("page        {url}"));
        if !quiet {
            open_browser(url);
        }
    }
}

/// Opens the page where there is a desktop; the address is printed in any case.
pub(crate) fn open_browser(url: &str) {
    let opener = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let quiet = std::process::Stdio::null;
    let spawned = std::process::Command::new(opener)
        .arg(url)
        .stdin(quiet())
        .stdout(quiet())
        .stderr(quiet())
        .spawn();
    if spawned.is_err() {
        print_line("            open it in a browser");
    }
}

//! Tells when to end: SIGINT, SIGTERM, or the end of stdin for a child whose parent died.

use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use tokio::signal::unix::{SignalKind, signal};

/// Returns a flag that is set on SIGINT or SIGTERM, and with `lifeline` when stdin ends.
///
/// # Errors
/// Fails if the handlers cannot be installed.
pub(crate) fn stop_flag(lifeline: bool) -> anyhow::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("simulator: cannot start the thread that waits for signals")?;
    // Installed before this returns, so that no signal falls between.
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt()).context("simulator: SIGINT")?;
    let mut terminate = signal(SignalKind::terminate()).context("simulator: SIGTERM")?;
    drop(guard);
    let set = Arc::clone(&flag);
    std::thread::spawn(move || {
        runtime.block_on(async {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
        });
        set.store(true, Ordering::Relaxed);
    });
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

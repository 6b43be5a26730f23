//! The end of the program: one flag that threads poll and tasks await.

use std::io::Read;
use std::sync::Arc;

use anyhow::{Context, Result};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;

/// A request to end, shared by all threads and tasks; set once, for good.
#[derive(Clone, Debug)]
pub struct Stop(Arc<watch::Sender<bool>>);

impl Default for Stop {
    fn default() -> Self {
        Self(Arc::new(watch::Sender::new(false)))
    }
}

impl Stop {
    /// Returns one that is set when this one is, and may be set before. Must run within a tokio
    /// runtime.
    pub fn child(&self) -> Self {
        let (parent, child) = (self.clone(), Self::default());
        let heir = child.clone();
        tokio::spawn(async move {
            tokio::select! {
                () = parent.wait() => heir.set(),
                () = heir.wait() => {}
            }
        });
        child
    }

    /// Asks everything to end.
    pub fn set(&self) {
        self.0.send_replace(true);
    }

    /// Whether the end was asked for.
    pub fn is_set(&self) -> bool {
        *self.0.borrow()
    }

    /// Completes when the end is asked for.
    pub async fn wait(&self) {
        let mut receiver = self.0.subscribe();
        // An error means that the sender is gone; `self` holds it.
        let _ = receiver.wait_for(|set| *set).await;
    }

    /// Sets the flag on SIGINT, SIGTERM, and with `lifeline` when stdin ends. Must run within
    /// a tokio runtime.
    pub fn on_signals(&self, lifeline: bool) -> Result<()> {
        let mut interrupt = signal(SignalKind::interrupt()).context("cannot handle SIGINT")?;
        let mut terminate = signal(SignalKind::terminate()).context("cannot handle SIGTERM")?;
        let stop = self.clone();
        tokio::spawn(async move {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            stop.set();
        });
        if lifeline {
            let stop = self.clone();
            // A thread of its own, never joined: a blocking read of stdin cannot be cancelled.
            std::thread::Builder::new()
                .name("lifeline".to_owned())
                .spawn(move || {
                    let mut buffer = [0; 64];
                    let mut stdin = std::io::stdin().lock();
                    while !matches!(stdin.read(&mut buffer), Ok(0) | Err(_)) {}
                    stop.set();
                })
                .context("cannot start the thread that watches stdin")?;
        }
        Ok(())
    }
}

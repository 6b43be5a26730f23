//! Stop signal of the program, which threads poll and tasks await.

use std::sync::Arc;

use anyhow::Result;
use tokio::sync::watch;
use vizflyt_process::{on_interrupt, on_orphaned};

/// Stop signal shared by all threads and tasks; set once and never reset.
#[derive(Clone, Debug)]
pub struct Stop(Arc<watch::Sender<bool>>);

impl Default for Stop {
    fn default() -> Self {
        Self(Arc::new(watch::Sender::new(false)))
    }
}

impl Stop {
    /// Returns a signal that is set when this one is, and may be set before. Must run within a tokio runtime.
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

    /// Sets the signal.
    pub fn set(&self) {
        self.0.send_replace(true);
    }

    /// Returns whether the signal is set.
    pub fn is_set(&self) -> bool {
        *self.0.borrow()
    }

    /// Completes when the signal is set.
    pub async fn wait(&self) {
        let mut receiver = self.0.subscribe();
        // An error would mean that the sender is dropped, but `self` holds it.
        let _ = receiver.wait_for(|set| *set).await;
    }

    /// Sets the signal on SIGINT, SIGTERM, and with `lifeline` when standard input closes.
    pub fn on_signals(&self, lifeline: bool) -> Result<()> {
        let stop = self.clone();
        on_interrupt(move || {
            stop.set();
            false
        })?;
        if lifeline {
            let stop = self.clone();
            on_orphaned(move || stop.set())?;
        }
        Ok(())
    }
}

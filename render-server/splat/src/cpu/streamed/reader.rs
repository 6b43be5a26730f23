//! Thread that reads requested blocks, so that an image does not wait for the disk.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::{io, thread};

use super::file::{GEOMETRY, PackedScene};
use crate::cpu::scene::BLOCK;

/// Maximum number of blocks read ahead. Copying them costs an image 2 to 6 ms: about 14 MB, or 40 MB with all
/// harmonics.
const AHEAD: usize = 1024;

/// Block that was read.
#[derive(Debug)]
pub(super) struct Arrived {
    pub(super) block: u32,
    pub(super) geometry: Vec<f32>,
    pub(super) sh: Vec<u16>,
}

#[derive(Debug, Default)]
struct Shared {
    /// Requested blocks, the most urgent last.
    wanted: Vec<u32>,
    reads: bool,
    arrived: Vec<Arrived>,
    /// Buffers for reuse.
    spare: Vec<Arrived>,
    /// Error that ended the reading.
    fault: Option<String>,
    ends: bool,
}

impl Shared {
    fn is_busy(&self) -> bool {
        let asked = self.reads || !self.wanted.is_empty();
        asked && self.arrived.len() < AHEAD && self.fault.is_none()
    }
}

#[derive(Debug, Default)]
struct Channel {
    shared: Mutex<Shared>,
    changed: Condvar,
}

impl Channel {
    fn lock(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, shared: MutexGuard<'a, Shared>) -> MutexGuard<'a, Shared> {
        self.changed.wait(shared).unwrap_or_else(PoisonError::into_inner)
    }
}

/// Reader thread; stops when this value is dropped.
#[derive(Debug)]
pub(super) struct Reader {
    channel: Arc<Channel>,
    thread: Option<JoinHandle<()>>,
}

impl Reader {
    pub(super) fn new(scene: PackedScene) -> io::Result<Self> {
        let channel = Arc::new(Channel::default());
        let theirs = Arc::clone(&channel);
        let thread = thread::Builder::new()
            .name("scene-reader".to_owned())
            .spawn(move || read_all(scene, &theirs))?;
        Ok(Self { channel, thread: Some(thread) })
    }

    /// Replaces the requested blocks; the most urgent is last. `wanted` receives the previous list.
    pub(super) fn ask(&self, wanted: &mut Vec<u32>) {
        std::mem::swap(&mut self.channel.lock().wanted, wanted);
        self.channel.changed.notify_all();
    }

    /// Exchanges arrived blocks for free buffers. With `waits`, waits until all requested blocks have arrived, or
    /// until the maximum read ahead is reached.
    ///
    /// # Errors
    /// Error that ended the reading.
    pub(super) fn take(&self, arrived: &mut Vec<Arrived>, waits: bool) -> Result<(), String> {
        let mut shared = self.channel.lock();
        shared.spare.append(arrived);
        while waits && shared.is_busy() {
            shared = self.channel.wait(shared);
        }
        if let Some(fault) = &shared.fault {
            return Err(fault.clone());
        }
        std::mem::swap(&mut shared.arrived, arrived);
        self.channel.changed.notify_all();
        Ok(())
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.channel.lock().ends = true;
        self.channel.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            // A panic there has already been reported.
            let _ = thread.join();
        }
    }
}

/// Reads requested blocks until the end is signalled or an error occurs.
fn read_all(mut scene: PackedScene, channel: &Channel) {
    let harmonics = scene.coefficients * 3 * BLOCK;
    let mut shared = channel.lock();
    while !shared.ends {
        let room = shared.arrived.len() < AHEAD;
        let Some(block) = room.then(|| shared.wanted.pop()).flatten() else {
            shared = channel.wait(shared);
            continue;
        };
        // Requested again before it was taken.
        if shared.arrived.iter().any(|arrived| arrived.block == block) {
            channel.changed.notify_all();
            continue;
        }
        let mut into = shared.spare.pop().unwrap_or_else(|| Arrived {
            block,
            geometry: vec![0.0; GEOMETRY],
            sh: vec![0; harmonics],
        });
        shared.reads = true;
        drop(shared);
        into.block = block;
        let read = scene.read(block as usize, &mut into.geometry, &mut into.sh);
        shared = channel.lock();
        shared.reads = false;
        match read {
            Ok(()) => shared.arrived.push(into),
            Err(error) => {
                shared.fault = Some(error.to_string());
                shared.ends = true;
            }
        }
        channel.changed.notify_all();
    }
}

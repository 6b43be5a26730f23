//! Text on standard output and standard error, on request without ever waiting for its reader.
//!
//! A write to a full pipe, a stopped terminal or a slow disk blocks. Nothing that flies a vehicle may wait for it, so
//! commands that fly or serve call [`never_wait_for_readers`] first: from then on text goes through bounded queues to
//! one thread per stream, and text that finds its queue full is dropped and counted.

use std::backtrace::{Backtrace, BacktraceStatus};
use std::fmt::Display;
use std::io::Write;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use nix::sys::signal::{SigSet, SigmaskHow};

/// Number of writes that a queue holds.
const QUEUE: usize = 1024;
/// Maximum time for which [`finish_output`] waits for each stream.
const FINISH: Duration = Duration::from_millis(500);

/// Standard output or standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputStream {
    /// Standard output.
    Out,
    /// Standard error.
    Error,
}

/// Queues of standard output and standard error, once [`never_wait_for_readers`] has been called.
static QUEUES: OnceLock<[Queue; 2]> = OnceLock::new();

#[derive(Debug)]
struct Queue {
    sender: SyncSender<Item>,
    /// Number of writes dropped since the last one that found room.
    dropped: AtomicU64,
}

#[derive(Debug)]
enum Item {
    Text(Vec<u8>),
    /// Answered when everything before it has been written.
    Finish(SyncSender<()>),
}

/// Prints a line on standard output. Unlike `println!`, it does not panic if the reader has closed the pipe.
pub fn print_line(line: impl Display) {
    print_text(OutputStream::Out, format!("{line}\n").as_bytes());
}

/// Prints a line on standard error. Unlike `eprintln!`, it does not panic if the reader has closed the pipe.
pub fn print_error(line: impl Display) {
    print_text(OutputStream::Error, format!("{line}\n").as_bytes());
}

/// Prints text as it is; see [`print_line`].
pub fn print_text(stream: OutputStream, text: &[u8]) {
    let Some(queues) = QUEUES.get() else { return write(stream, text) };
    let queue = &queues[stream as usize];
    if queue.sender.try_send(Item::Text(text.to_vec())).is_err() {
        queue.dropped.fetch_add(1, Ordering::Relaxed);
    }
}

/// Writer of logs on standard error: one write per event, through the queue if there is one.
#[derive(Clone, Copy, Debug, Default)]
pub struct LogWriter;

impl Write for LogWriter {
    fn write(&mut self, event: &[u8]) -> std::io::Result<usize> {
        print_text(OutputStream::Error, event);
        Ok(event.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Makes all later output of this process, that of panics included, independent of its readers; see the module. Call
/// [`finish_output`] before the process ends.
///
/// # Panics
/// If a thread cannot be started.
pub fn never_wait_for_readers() {
    QUEUES.get_or_init(|| [OutputStream::Out, OutputStream::Error].map(start));
    std::panic::set_hook(Box::new(|panic| {
        let thread = std::thread::current();
        let name = thread.name().unwrap_or("unnamed");
        // Empty unless RUST_BACKTRACE is set, as in the standard hook.
        let backtrace = Backtrace::capture();
        let text = match backtrace.status() {
            BacktraceStatus::Captured => format!("\n{backtrace}"),
            _ => String::new(),
        };
        print_error(format_args!("thread '{name}' {panic}{text}"));
    }));
}

/// Waits until queued text has been written, for half a second per stream at most.
pub fn finish_output() {
    for queue in QUEUES.get().into_iter().flatten() {
        let deadline = Instant::now() + FINISH;
        let (done, is_done) = sync_channel(1);
        while queue.sender.try_send(Item::Finish(done.clone())).is_err() {
            if Instant::now() >= deadline {
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = is_done.recv_timeout(deadline.saturating_duration_since(Instant::now()));
    }
}

fn start(stream: OutputStream) -> Queue {
    let (sender, items) = sync_channel(QUEUE);
    // Signals are for the other threads: a program that waits for them blocks them in its own threads only.
    let before = SigSet::all().thread_swap_mask(SigmaskHow::SIG_BLOCK);
    std::thread::Builder::new()
        .name(format!("output-{stream:?}").to_lowercase())
        .spawn(move || drain(stream, &items))
        .expect("a thread starts");
    if let Ok(before) = before {
        let _ = before.thread_set_mask();
    }
    Queue { sender, dropped: AtomicU64::new(0) }
}

/// Writes items until the process ends.
fn drain(stream: OutputStream, items: &Receiver<Item>) {
    while let Ok(item) = items.recv() {
        let dropped = QUEUES
            .get()
            .map_or(0, |queues| queues[stream as usize].dropped.swap(0, Ordering::Relaxed));
        if dropped > 0 {
            let note =
                format!("({dropped} lines of output were dropped: their reader is too slow)\n");
            write(stream, note.as_bytes());
        }
        match item {
            Item::Text(text) => write(stream, &text),
            Item::Finish(done) => {
                let _ = done.send(());
            }
        }
    }
}

/// Writes text and ignores errors: the reader may have ended.
fn write(stream: OutputStream, text: &[u8]) {
    let _ = match stream {
        OutputStream::Out => {
            let mut out = std::io::stdout().lock();
            out.write_all(text).and_then(|()| out.flush())
        }
        OutputStream::Error => std::io::stderr().lock().write_all(text),
    };
}

//! Writes a file that is a valid MCAP file after each write, also if the process is killed or the disk
//! is full.
//!
//! Data is collected in memory until a chunk is complete, and then written to disk in one write together
//! with an MCAP end; the next chunk overwrites that end. The file contains an incomplete chunk only during
//! that write, and streaming readers can then read all data before it. After a failed write, the file is
//! truncated to the last complete chunk.

use std::fs::File;
use std::io::{self, Error, ErrorKind, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;

/// Shortest end of an MCAP file: a `DataEnd` record without a checksum, a `Footer` without a summary, and
/// the magic bytes (MCAP specification, "DataEnd", "Footer").
const END: [u8; 50] = {
    let mut end = [0; 50];
    (end[0], end[1]) = (0x0f, 4);
    (end[13], end[14]) = (0x02, 20);
    let mut at = 0;
    while at < mcap::MAGIC.len() {
        end[42 + at] = mcap::MAGIC[at];
        at += 1;
    }
    end
};

/// File operations; tests simulate full disks.
pub(super) trait Disk {
    /// Writes all of `bytes` at `offset`.
    fn write_at(&mut self, bytes: &[u8], offset: u64) -> io::Result<()>;
    /// Truncates the file to `len`.
    fn cut(&mut self, len: u64) -> io::Result<()>;
    /// Called after each chunk, which should then be synchronized to the medium.
    fn written(&mut self) {}
}

/// File with a thread that synchronizes its chunks to the medium, so that a power failure loses only
/// seconds, and the writer never waits.
pub(super) struct RealFile {
    file: File,
    due: SyncSender<()>,
}

impl RealFile {
    pub(super) fn new(file: File) -> io::Result<Self> {
        let (due, chunks) = sync_channel::<()>(1);
        let same = file.try_clone()?;
        thread::Builder::new().name("flight-log-sync".into()).spawn(move || {
            while chunks.recv().is_ok() {
                // The next write reports a failed disk.
                let _ = same.sync_data();
            }
        })?;
        Ok(Self { file, due })
    }
}

impl Disk for RealFile {
    fn write_at(&mut self, bytes: &[u8], offset: u64) -> io::Result<()> {
        self.file.write_all_at(bytes, offset)
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.file.set_len(len)
    }

    fn written(&mut self) {
        // If the channel is full, a synchronization is pending already.
        let _ = self.due.try_send(());
    }
}

/// Ignores SIGXFSZ, so that writes beyond a size limit (`ulimit -f`) fail like those to a full disk,
/// instead of ending the process. Call it before threads start: it applies to the complete process.
#[allow(unsafe_code, reason = "sets how a signal is handled")]
pub fn keep_going_when_files_are_full() {
    use nix::sys::signal::{SigHandler, Signal, signal};
    // SAFETY: ignoring a signal installs no handler, so no code runs in its context.
    let result = unsafe { signal(Signal::SIGXFSZ, SigHandler::SigIgn) };
    if let Err(error) = result {
        tracing::debug!("SIGXFSZ: {error}");
    }
}

/// Returns the free space of a file's disk, if available. [bytes]
pub(super) fn free_bytes(file: &File) -> Option<u64> {
    let stat = nix::sys::statvfs::fstatvfs(file).ok()?;
    Some(stat.blocks_available().saturating_mul(stat.fragment_size()))
}

/// File that is valid after each chunk. `flush` completes a chunk.
pub(super) struct SafeFile<D> {
    disk: D,
    /// Offset of `waiting` on disk.
    start: u64,
    waiting: Vec<u8>,
    /// Position of the next byte in `waiting`.
    at: usize,
}

impl<D: Disk> SafeFile<D> {
    pub(super) fn new(disk: D) -> Self {
        Self { disk, start: 0, waiting: Vec::new(), at: 0 }
    }
}

impl<D: Disk> Write for SafeFile<D> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let over = bytes.len().min(self.waiting.len() - self.at);
        self.waiting[self.at..self.at + over].copy_from_slice(&bytes[..over]);
        self.waiting.extend_from_slice(&bytes[over..]);
        self.at += bytes.len();
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let len = self.waiting.len();
        // A finished file has an end already.
        if !self.waiting.ends_with(mcap::MAGIC) {
            self.waiting.extend_from_slice(&END);
        }
        let result = self.disk.write_at(&self.waiting, self.start);
        self.waiting.clear();
        self.at = 0;
        if let Err(error) = result {
            // Truncating frees space for the end.
            self.disk.cut(self.start)?;
            if self.start > 0 {
                self.disk.write_at(&END, self.start)?;
            }
            return Err(error);
        }
        self.start += len as u64;
        self.disk.written();
        Ok(())
    }
}

impl<D: Disk> Seek for SafeFile<D> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let end = self.start + self.waiting.len() as u64;
        let target = match to {
            SeekFrom::Start(offset) => Some(offset),
            SeekFrom::End(offset) => end.checked_add_signed(offset),
            SeekFrom::Current(offset) => (self.start + self.at as u64).checked_add_signed(offset),
        };
        // Data on disk cannot be changed any more.
        let target = target
            .filter(|target| (self.start..=end).contains(target))
            .ok_or_else(|| Error::new(ErrorKind::InvalidInput, "outside the chunk"))?;
        self.at = (target - self.start) as usize;
        Ok(target)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;
    use std::rc::Rc;

    /// Disk with a size limit. [bytes]
    #[derive(Clone)]
    struct Small {
        bytes: Rc<RefCell<Vec<u8>>>,
        room: usize,
    }

    impl Disk for Small {
        fn write_at(&mut self, bytes: &[u8], offset: u64) -> io::Result<()> {
            let mut disk = self.bytes.borrow_mut();
            let offset = offset as usize;
            let fits = bytes.len().min(self.room.saturating_sub(offset));
            let len = disk.len().max(offset + fits);
            disk.resize(len, 0);
            disk[offset..offset + fits].copy_from_slice(&bytes[..fits]);
            if fits < bytes.len() { Err(ErrorKind::StorageFull.into()) } else { Ok(()) }
        }

        fn cut(&mut self, len: u64) -> io::Result<()> {
            self.bytes.borrow_mut().truncate(len as usize);
            Ok(())
        }
    }

    type Written = (Rc<RefCell<Vec<u8>>>, mcap::Writer<SafeFile<Small>>, u16);

    fn writer(room: usize) -> Written {
        let disk = Small { bytes: Rc::default(), room };
        let bytes = Rc::clone(&disk.bytes);
        let options = mcap::WriteOptions::new().compression(None).chunk_size(None);
        let mut writer = options.create(SafeFile::new(disk)).unwrap();
        let channel = writer.add_channel(0, "/x", "json", &std::collections::BTreeMap::new());
        (bytes, writer, channel.unwrap())
    }

    fn write(writer: &mut mcap::Writer<SafeFile<Small>>, channel_id: u16, sequence: u32) {
        let header =
            mcap::records::MessageHeader { channel_id, sequence, log_time: 1, publish_time: 1 };
        writer.write_to_known_channel(&header, &[b'x'; 300]).unwrap();
    }

    /// Reads with a strict reader, to the end.
    fn read(bytes: &Rc<RefCell<Vec<u8>>>) -> usize {
        let bytes = bytes.borrow();
        mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).count()
    }

    #[test]
    fn file_is_valid_after_each_chunk() {
        let (bytes, mut writer, channel) = writer(usize::MAX);
        let mut sequence = 0;
        for chunk in 1..5 {
            for _ in 0..chunk {
                sequence += 1;
                write(&mut writer, channel, sequence);
                // The file on disk is valid, without the waiting messages.
                if chunk > 1 {
                    read(&bytes);
                }
            }
            writer.flush().unwrap();
            assert_eq!(read(&bytes), sequence as usize);
        }
        writer.finish().unwrap();
        assert_eq!(read(&bytes), 10);
        let summary = mcap::Summary::read(&bytes.borrow()).unwrap().expect("the file has an index");
        assert_eq!(summary.stats.unwrap().message_count, 10);
    }

    #[test]
    fn full_disk_keeps_the_chunks_before_it() {
        // Tries many disk sizes: the file is always valid.
        let mut most = 0;
        for room in (400..4000).step_by(7) {
            let (bytes, mut writer, channel) = writer(room);
            let mut chunks = 0;
            while chunks < 8 {
                write(&mut writer, channel, chunks);
                if writer.flush().is_err() {
                    break;
                }
                chunks += 1;
            }
            // After a failed write, dropping the writer writes nothing.
            drop(writer);
            if chunks > 0 {
                assert_eq!(read(&bytes), chunks as usize, "room for {room}");
            }
            most = most.max(chunks);
        }
        assert!(most > 4);
    }
}

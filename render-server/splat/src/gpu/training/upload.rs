//! Memory that the host writes and the device copies from; reused for each step, because its allocation costs more
//! than the copy. All cores write, because one core reaches only about 5 GB/s.

use rayon::prelude::*;

use super::super::device::Device;

/// Buffer that the host can write until [`Self::hand_over`], and again after [`Self::map`] when the submission is
/// done.
#[derive(Debug)]
pub(super) struct Upload {
    buffer: wgpu::Buffer,
}

/// Bytes that one task copies at a time; views of the memory start at multiples of 8.
pub(super) const PART: usize = 1 << 16;

impl Upload {
    /// Returns a buffer of at least `bytes` bytes; reuses `old` if it is large enough.
    pub(super) fn of(old: Option<Self>, device: &Device, bytes: u64) -> Self {
        old.filter(|old| old.buffer.size() >= bytes).unwrap_or_else(|| Self {
            buffer: device.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("upload"),
                size: (bytes + bytes / 4).max(PART as u64).next_multiple_of(16),
                usage: wgpu::BufferUsages::MAP_WRITE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: true,
            }),
        })
    }

    /// Writes `bytes` at offset `at`, a multiple of 8; their number must be a multiple of 4.
    ///
    /// # Errors
    /// If the device is lost.
    pub(super) fn write(&self, at: u64, bytes: &[u8]) -> Result<(), String> {
        bytes.par_chunks(PART).enumerate().try_for_each(|(part, bytes)| {
            let at = at + (part * PART) as u64;
            self.view(at, bytes.len())?.copy_from_slice(bytes);
            Ok(())
        })
    }

    /// Writes pieces of `bytes` bytes each, a multiple of 4, one after the other from offset `at` on, a multiple of
    /// 8.
    ///
    /// # Errors
    /// If the device is lost.
    pub(super) fn gather<'a>(
        &self,
        at: u64,
        bytes: usize,
        count: usize,
        piece: impl Fn(usize) -> &'a [u8] + Sync,
    ) -> Result<(), String> {
        // An even number, so that every part starts at a multiple of 8.
        let together = (PART / bytes).max(1).next_multiple_of(2);
        (0..count.div_ceil(together)).into_par_iter().try_for_each(|part| {
            let pieces = part * together..count.min((part + 1) * together);
            let at = at + (pieces.start * bytes) as u64;
            let mut view = self.view(at, pieces.len() * bytes)?;
            for (i, n) in pieces.enumerate() {
                view.slice(i * bytes..(i + 1) * bytes).copy_from_slice(piece(n));
            }
            Ok(())
        })
    }

    /// Ends writing, and adds a copy of the first bytes to the start of a buffer.
    pub(super) fn hand_over(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        to: &wgpu::Buffer,
        bytes: u64,
    ) {
        self.buffer.unmap();
        encoder.copy_buffer_to_buffer(&self.buffer, 0, to, 0, bytes);
    }

    /// Starts mapping again; the memory is available when the submission is done and the device was polled.
    pub(super) fn map(&self) {
        // The result is checked later: an unmapped buffer has no view.
        self.buffer.map_async(wgpu::MapMode::Write, .., |_| ());
    }

    fn view(&self, at: u64, bytes: usize) -> Result<wgpu::BufferViewMut, String> {
        let range = at..at + bytes as u64;
        self.buffer.get_mapped_range_mut(range).map_err(|error| error.to_string())
    }
}

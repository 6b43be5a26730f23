//! Depth for viewers (`--log-depth`): the only pixels that the log decodes.
//!
//! Cost per kept image: one decode on the thread of the log, and 614 kB of file size at 640x480.

use vizflyt_rgbd::{Decoder, peek};

/// Decodes depth from received images. Reuses its buffers.
#[derive(Debug, Default)]
pub(super) struct DepthReader {
    decoder: Decoder,
    bitstream: Vec<u8>,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
}

impl DepthReader {
    /// Returns the depth of an image, row-major H x W, 0 without a return; `None` if its pieces do not decode.
    /// [mm, cam]
    pub(super) fn read(&mut self, pieces: &[Vec<u8>]) -> Option<&[u16]> {
        self.bitstream.clear();
        for piece in pieces {
            self.bitstream.extend_from_slice(piece);
        }
        let info = peek(&self.bitstream).ok()?;
        let pixels = info.width as usize * info.height as usize;
        self.rgb.resize(3 * pixels, 0);
        self.depth_mm.clear();
        self.depth_mm.resize(pixels, 0);
        self.decoder.decode(&self.bitstream, &mut self.rgb, &mut self.depth_mm).ok()?;
        Some(&self.depth_mm)
    }
}

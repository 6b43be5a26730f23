//! The two ends: [`Encoder`] and [`Decoder`].

use zerocopy::IntoBytes;

use crate::color::{decode_jpeg, encode_jpeg};
use crate::depth::{DepthDecoder, DepthEncoder};
use crate::header::{DepthMode, Header, Info, MAX_SIDE, parse};

/// An RGB-D image to encode; row-major. An empty slice leaves that part out.
#[derive(Clone, Copy, Debug)]
pub struct RgbdView<'a> {
    /// Width. [px]
    pub width: u32,
    /// Height. [px]
    pub height: u32,
    /// H x W x 3, or empty.
    pub rgb: &'a [u8],
    /// H x W camera-z depth, 0 where there is no return; or empty. [mm]
    pub depth_mm: &'a [u16],
}

/// What an encoder may choose; every choice is written into the bitstream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EncodeOptions {
    /// JPEG quality of colour, 1 to 100.
    pub jpeg_quality: u8,
    /// How depth is stored.
    pub depth_mode: DepthMode,
}

impl Default for EncodeOptions {
    /// Quality 93 keeps every measured image at 38 dB or better; fast lossless depth.
    fn default() -> Self {
        Self { jpeg_quality: 93, depth_mode: DepthMode::Fast }
    }
}

/// Why an image is not encoded. All are the caller's to mend; none depends on pixel values.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EncodeError {
    /// A side is 0 or too large.
    #[error("image size {0}x{1} is outside 1x1 to {MAX_SIDE}x{MAX_SIDE}")]
    Size(u32, u32),
    /// Colour of another size.
    #[error("colour has {found} bytes; {width}x{height} needs {expected}")]
    Rgb {
        /// Bytes given.
        found: usize,
        /// Bytes needed.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// Depth of another size.
    #[error("depth has {found} pixels; {width}x{height} needs {expected}")]
    Depth {
        /// Pixels given.
        found: usize,
        /// Pixels needed.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// Quality out of range.
    #[error("JPEG quality {0} is outside 1 to 100")]
    Quality(u8),
    /// The JPEG library declined.
    #[error("JPEG: {0}")]
    Jpeg(String),
}

/// Why bytes are no image, or not the one the caller has room for.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Fewer bytes than a header.
    #[error("RGB-D image is cut short at {0} of {size} header bytes", size = Header::SIZE)]
    Short(usize),
    /// Another kind of bytes.
    #[error("these bytes are no RGB-D image: they start with {0:02x?}")]
    Foreign([u8; 4]),
    /// A bitstream of another version.
    #[error("RGB-D bitstream version {0} is unknown; update the older of the two programs")]
    Version(u8),
    /// A mode of a part that this program does not know.
    #[error("RGB-D image has unknown {0} mode {1}; update the older of the two programs")]
    Mode(&'static str, u8),
    /// A side is 0 or too large.
    #[error("RGB-D image size {0}x{1} is outside 1x1 to {MAX_SIDE}x{MAX_SIDE}")]
    Size(u32, u32),
    /// More or fewer bytes than the header names.
    #[error("RGB-D image has {found} bytes; its header names {expected}")]
    Length {
        /// Bytes that the header names, with itself.
        expected: u64,
        /// Bytes given.
        found: usize,
    },
    /// The caller asks for a part that is absent, or its slice has another size.
    #[error("{part} goes into a slice of {found}, but the {width}x{height} image has {expected}")]
    Slice {
        /// `colour` (bytes) or `depth` (pixels).
        part: &'static str,
        /// Length of the caller's slice.
        found: usize,
        /// Length needed; 0 if the part is absent.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// The colour part is damaged.
    #[error("colour is damaged: {0}")]
    Color(String),
    /// The depth part is damaged.
    #[error("depth is damaged: {found} bytes where its block widths need {expected}")]
    Depth {
        /// Bytes of the part.
        found: usize,
        /// Bytes that its own table needs.
        expected: usize,
    },
}

/// Turns images into bitstreams; owns the scratch memory.
#[derive(Clone, Debug, Default)]
pub struct Encoder {
    options: EncodeOptions,
    depth: DepthEncoder,
}

impl Encoder {
    /// Makes an encoder.
    pub fn new(options: EncodeOptions) -> Self {
        Self { options, depth: DepthEncoder::default() }
    }

    /// Changes what the next image is encoded with.
    pub fn set_options(&mut self, options: EncodeOptions) {
        self.options = options;
    }

    /// Replaces `out` by the bitstream of one image.
    ///
    /// # Errors
    /// Every [`EncodeError`]; `out` then holds nothing of use.
    pub fn encode(&mut self, view: &RgbdView<'_>, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let RgbdView { width, height, rgb, depth_mm } = *view;
        let side = 1..=MAX_SIDE;
        if !side.contains(&width) || !side.contains(&height) {
            return Err(EncodeError::Size(width, height));
        }
        let expected = width as usize * height as usize;
        if !depth_mm.is_empty() && depth_mm.len() != expected {
            return Err(EncodeError::Depth { found: depth_mm.len(), expected, width, height });
        }
        out.clear();
        out.extend_from_slice(&[0; Header::SIZE]);
        if !rgb.is_empty() {
            encode_jpeg(rgb, width, height, self.options.jpeg_quality, out)?;
        }
        let color_len = out.len() - Header::SIZE;
        if !depth_mm.is_empty() {
            match self.options.depth_mode {
                DepthMode::Fast => self.depth.encode(depth_mm, width as usize, out),
            }
        }
        let info = Info {
            width,
            height,
            has_color: !rgb.is_empty(),
            depth_mode: (!depth_mm.is_empty()).then_some(self.options.depth_mode),
            color_len,
            depth_len: out.len() - Header::SIZE - color_len,
        };
        out[..Header::SIZE].copy_from_slice(Header::new(&info).as_bytes());
        Ok(())
    }
}

/// Turns bitstreams into images; owns the scratch memory.
#[derive(Clone, Debug, Default)]
pub struct Decoder {
    depth: DepthDecoder,
}

impl Decoder {
    /// Makes a decoder.
    pub fn new() -> Self {
        Self::default()
    }

    /// Decodes into the caller's slices: H x W x 3 colour and H x W depth [mm]. An empty slice
    /// leaves its part undecoded. Sizes are checked before any pixel is written; after a later
    /// error the slices hold part of an image.
    ///
    /// # Errors
    /// Every [`DecodeError`], in time and memory bounded by the bytes and the slices.
    pub fn decode(
        &mut self,
        bytes: &[u8],
        rgb_out: &mut [u8],
        depth_out: &mut [u16],
    ) -> Result<(), DecodeError> {
        let (info, color, depth) = parse(bytes)?;
        let Info { width, height, .. } = info;
        let pixels = width as usize * height as usize;
        let check = |part, found: usize, present: bool, expected: usize| {
            let expected = if present { expected } else { 0 };
            if found == 0 || found == expected {
                return Ok(());
            }
            Err(DecodeError::Slice { part, found, expected, width, height })
        };
        check("colour", rgb_out.len(), info.has_color, 3 * pixels)?;
        check("depth", depth_out.len(), info.depth_mode.is_some(), pixels)?;
        if !depth_out.is_empty() {
            match info.depth_mode {
                Some(DepthMode::Fast) => self.depth.decode(depth, width as usize, depth_out)?,
                None => {}
            }
        }
        if !rgb_out.is_empty() {
            decode_jpeg(color, width, height, rgb_out)?;
        }
        Ok(())
    }
}

//! Codecs behind a common trait.

use std::io::Cursor;

use vizflyt_rgbd::{Decoder, EncodeOptions, Encoder, ImageMut, ImageView};
use zerocopy::IntoBytes;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::images::Image;
use crate::rvl;

/// A codec with its scratch memory and its last output.
pub(crate) trait Codec {
    /// Encodes an image; returns the number of bytes.
    fn encode(&mut self, image: &Image) -> usize;
    /// Decodes the last output.
    fn decode(&mut self, back: &mut Image);
}

/// Parts of an image that a codec receives.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Given {
    Color,
    Depth,
    Both,
}

/// This crate.
pub(crate) struct Ours {
    given: Given,
    encoder: Encoder,
    decoder: Decoder,
    bytes: Vec<u8>,
}

impl Ours {
    pub(crate) fn new(given: Given, options: EncodeOptions) -> Self {
        let (encoder, decoder) = (Encoder::new(options), Decoder::new());
        Self { given, encoder, decoder, bytes: Vec::new() }
    }
}

impl Codec for Ours {
    fn encode(&mut self, image: &Image) -> usize {
        let view = ImageView {
            width: image.width,
            height: image.height,
            rgb: if self.given == Given::Depth { &[] } else { &image.rgb },
            depth_mm: if self.given == Given::Color { &[] } else { &image.depth_mm },
            ..ImageView::default()
        };
        self.encoder.encode(view, &mut self.bytes).expect("a good image");
        self.bytes.len()
    }

    fn decode(&mut self, back: &mut Image) {
        let mut out = ImageMut::default();
        if self.given != Given::Depth {
            out.rgb = &mut back.rgb;
        }
        if self.given != Given::Color {
            out.depth_mm = &mut back.depth_mm;
        }
        self.decoder.decode_image(&self.bytes, &mut out).expect("our own bytes");
    }
}

#[derive(Default)]
pub(crate) struct Rvl(Vec<u32>);

impl Codec for Rvl {
    fn encode(&mut self, image: &Image) -> usize {
        self.0 = rvl::encode(&image.depth_mm);
        4 * self.0.len()
    }

    fn decode(&mut self, back: &mut Image) {
        rvl::decode(&self.0, &mut back.depth_mm);
    }
}

/// Zstandard, level 1, on the bytes of the pixels.
pub(crate) struct Zstd {
    given: Given,
    compressor: zstd::bulk::Compressor<'static>,
    decompressor: zstd::bulk::Decompressor<'static>,
    bytes: Vec<u8>,
}

impl Zstd {
    pub(crate) fn new(given: Given) -> Self {
        Self {
            given,
            compressor: zstd::bulk::Compressor::new(1).expect("memory"),
            decompressor: zstd::bulk::Decompressor::new().expect("memory"),
            bytes: Vec::new(),
        }
    }
}

fn pixels(given: Given, image: &Image) -> &[u8] {
    if given == Given::Color { &image.rgb } else { image.depth_mm.as_bytes() }
}

fn pixels_mut(given: Given, image: &mut Image) -> &mut [u8] {
    if given == Given::Color { &mut image.rgb } else { image.depth_mm.as_mut_bytes() }
}

impl Codec for Zstd {
    fn encode(&mut self, image: &Image) -> usize {
        let pixels = pixels(self.given, image);
        self.bytes.clear();
        self.bytes.reserve(zstd::zstd_safe::compress_bound(pixels.len()));
        self.compressor.compress_to_buffer(pixels, &mut self.bytes).expect("room")
    }

    fn decode(&mut self, back: &mut Image) {
        let pixels = pixels_mut(self.given, back);
        self.decompressor.decompress_to_buffer(&self.bytes, pixels).expect("our own bytes");
    }
}

/// LZ4 blocks, on the bytes of the pixels.
pub(crate) struct Lz4 {
    given: Given,
    bytes: Vec<u8>,
    len: usize,
}

impl Lz4 {
    pub(crate) fn new(given: Given) -> Self {
        Self { given, bytes: Vec::new(), len: 0 }
    }
}

impl Codec for Lz4 {
    fn encode(&mut self, image: &Image) -> usize {
        let pixels = pixels(self.given, image);
        self.bytes.resize(lz4_flex::block::get_maximum_output_size(pixels.len()), 0);
        self.len = lz4_flex::block::compress_into(pixels, &mut self.bytes).expect("room");
        self.len
    }

    fn decode(&mut self, back: &mut Image) {
        let pixels = pixels_mut(self.given, back);
        lz4_flex::block::decompress_into(&self.bytes[..self.len], pixels).expect("our own bytes");
    }
}

/// PNG with 16 bits, in its fast setting.
#[derive(Default)]
pub(crate) struct Png16 {
    bytes: Vec<u8>,
    big_endian: Vec<u8>,
}

impl Codec for Png16 {
    fn encode(&mut self, image: &Image) -> usize {
        self.big_endian.clear();
        self.big_endian.extend(image.depth_mm.iter().flat_map(|mm| mm.to_be_bytes()));
        self.bytes.clear();
        let mut encoder = png::Encoder::new(&mut self.bytes, image.width, image.height);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Sixteen);
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header().expect("memory");
        writer.write_image_data(&self.big_endian).expect("memory");
        writer.finish().expect("memory");
        self.bytes.len()
    }

    fn decode(&mut self, back: &mut Image) {
        let mut reader =
            png::Decoder::new(Cursor::new(&self.bytes)).read_info().expect("our own bytes");
        self.big_endian.resize(2 * back.depth_mm.len(), 0);
        reader.next_frame(&mut self.big_endian).expect("our own bytes");
        for (mm, bytes) in back.depth_mm.iter_mut().zip(self.big_endian.as_chunks().0) {
            *mm = u16::from_be_bytes(*bytes);
        }
    }
}

#[derive(Default)]
pub(crate) struct Qoi(Vec<u8>);

impl Codec for Qoi {
    fn encode(&mut self, image: &Image) -> usize {
        self.0.resize(qoi::encode_max_len(image.width, image.height, 3), 0);
        let len =
            qoi::encode_to_buf(&mut self.0, &image.rgb, image.width, image.height).expect("room");
        self.0.truncate(len);
        len
    }

    fn decode(&mut self, back: &mut Image) {
        qoi::decode_to_buf(&mut back.rgb, &self.0).expect("our own bytes");
    }
}

/// `jpeg-encoder` and `zune-jpeg`, quality 93.
pub(crate) struct PureJpeg {
    sampling: jpeg_encoder::SamplingFactor,
    bytes: Vec<u8>,
}

impl PureJpeg {
    pub(crate) fn new(sampling: jpeg_encoder::SamplingFactor) -> Self {
        Self { sampling, bytes: Vec::new() }
    }
}

impl Codec for PureJpeg {
    fn encode(&mut self, image: &Image) -> usize {
        self.bytes.clear();
        let mut encoder = jpeg_encoder::Encoder::new(&mut self.bytes, 93);
        encoder.set_sampling_factor(self.sampling);
        let (width, height) = (image.width as u16, image.height as u16);
        encoder
            .encode(&image.rgb, width, height, jpeg_encoder::ColorType::Rgb)
            .expect("a good image");
        self.bytes.len()
    }

    fn decode(&mut self, back: &mut Image) {
        let options = DecoderOptions::new_fast();
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(&self.bytes), options);
        decoder.decode_into(&mut back.rgb).expect("our own bytes");
    }
}

/// libjpeg-turbo, quality 93.
#[cfg(feature = "turbo")]
pub(crate) struct TurboJpeg {
    compressor: turbojpeg::Compressor,
    decompressor: turbojpeg::Decompressor,
    bytes: Vec<u8>,
    len: usize,
}

#[cfg(feature = "turbo")]
impl TurboJpeg {
    pub(crate) fn new(subsamp: turbojpeg::Subsamp) -> Self {
        let mut compressor = turbojpeg::Compressor::new().expect("memory");
        compressor.set_quality(93).expect("a quality");
        compressor.set_subsamp(subsamp).expect("a subsampling");
        let decompressor = turbojpeg::Decompressor::new().expect("memory");
        Self { compressor, decompressor, bytes: Vec::new(), len: 0 }
    }
}

#[cfg(feature = "turbo")]
impl Codec for TurboJpeg {
    fn encode(&mut self, image: &Image) -> usize {
        let (width, height) = (image.width as usize, image.height as usize);
        self.bytes.resize(self.compressor.buf_len(width, height).expect("a size"), 0);
        let format = turbojpeg::PixelFormat::RGB;
        let pixels = image.rgb.as_slice();
        let image = turbojpeg::Image { pixels, width, pitch: 3 * width, height, format };
        self.len = self.compressor.compress_to_slice(image, &mut self.bytes).expect("room");
        self.len
    }

    fn decode(&mut self, back: &mut Image) {
        let (width, height) = (back.width as usize, back.height as usize);
        let format = turbojpeg::PixelFormat::RGB;
        let pixels = back.rgb.as_mut_slice();
        let image = turbojpeg::Image { pixels, width, pitch: 3 * width, height, format };
        self.decompressor.decompress(&self.bytes[..self.len], image).expect("our own bytes");
    }
}

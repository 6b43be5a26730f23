//! A picture with all parts, for tests.

use vizflyt_rgbd::{DecodeError, Decoder, EncodeOptions, Encoder, ImageMut, ImageView, peek};

/// Pixels of all parts.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Picture {
    width: u32,
    height: u32,
    pub(crate) rgb: Vec<u8>,
    pub(crate) depth_mm: Vec<u16>,
    pub(crate) alpha: Vec<u8>,
    pub(crate) ids: Vec<u16>,
}

impl Picture {
    /// Makes a picture of zeros.
    pub(crate) fn blank(width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        Self {
            width,
            height,
            rgb: vec![0; 3 * pixels],
            depth_mm: vec![0; pixels],
            alpha: vec![0; pixels],
            ids: vec![0; pixels],
        }
    }

    /// Makes a picture with textured smooth colour, depth and ids with edges and holes, and decreasing alpha.
    pub(crate) fn new(width: u32, height: u32) -> Self {
        let mut picture = Self::blank(width, height);
        for y in 0..height {
            for x in 0..width {
                let at = (y * width + x) as usize;
                let (u, v) = (f64::from(x) * 0.11, f64::from(y) * 0.07);
                let grain = f64::from((x * 7919 + y * 104_729) % 17) - 8.0;
                for (channel, phase) in [0.0, 1.0, 2.0].into_iter().enumerate() {
                    let value = 128.0 + 80.0 * (u + phase).sin() * (v - phase).cos() + grain;
                    picture.rgb[3 * at + channel] = value as u8;
                }
                (picture.depth_mm[at], picture.ids[at]) = match (x + y) % 50 {
                    0..3 => (0, 0),
                    3..25 => ((1500 + 2 * x + y) as u16, 7),
                    _ => ((9000 - y) as u16, (x / 40) as u16 * 1000),
                };
                picture.alpha[at] = 255 - (x * x / 40).min(255) as u8;
            }
        }
        picture
    }

    #[allow(dead_code)] // Why: used by only one of the two tests that share this module.
    /// Fills all parts with random values of `bits` bits, and depth also with holes.
    pub(crate) fn fill_at_random(&mut self, seed: u64, bits: u32) {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((state >> 48) as u32 >> (16 - bits)) as u16
        };
        self.depth_mm.fill_with(|| if next() & 7 == 1 { 0 } else { next() });
        self.ids.fill_with(&mut next);
        self.rgb.fill_with(|| next() as u8);
        self.alpha.fill_with(|| next() as u8);
    }

    pub(crate) fn view(&self) -> ImageView<'_> {
        let &Self { width, height, ref rgb, ref depth_mm, ref alpha, ref ids } = self;
        ImageView { width, height, rgb, depth_mm, alpha, ids }
    }

    pub(crate) fn room(&mut self) -> ImageMut<'_> {
        let Self { rgb, depth_mm, alpha, ids, .. } = self;
        ImageMut { rgb, depth_mm, alpha, ids }
    }

    pub(crate) fn encode(&self, options: EncodeOptions) -> Vec<u8> {
        let mut bytes = Vec::new();
        Encoder::new(options).encode(self.view(), &mut bytes).unwrap();
        bytes
    }

    pub(crate) fn decode(decoder: &mut Decoder, bytes: &[u8]) -> Result<Self, DecodeError> {
        let info = peek(bytes)?;
        let mut picture = Self::blank(info.width, info.height);
        decoder.decode_image(bytes, &mut picture.room())?;
        Ok(picture)
    }
}

/// Returns the peak signal-to-noise ratio of 8-bit values. [dB]
#[allow(dead_code)] // Why: used by only one of the two tests that share this module.
pub(crate) fn psnr_db(a: &[u8], b: &[u8]) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * (255.0f64.powi(2) / (squares / a.len() as f64)).log10()
}

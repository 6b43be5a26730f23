//! A grey image.

/// A grey image, rows from top to bottom, without padding.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Gray {
    width_px: u32,
    height_px: u32,
    pixels: Vec<u8>,
}

impl Gray {
    /// Makes an image of a single grey level.
    pub fn plain(width_px: u32, height_px: u32, grey: u8) -> Self {
        Self { width_px, height_px, pixels: vec![grey; width_px as usize * height_px as usize] }
    }

    /// Makes an image from H x W pixels; `None` if `pixels` has another length.
    pub fn new(width_px: u32, height_px: u32, pixels: Vec<u8>) -> Option<Self> {
        let count = (width_px as usize).checked_mul(height_px as usize)?;
        (pixels.len() == count).then_some(Self { width_px, height_px, pixels })
    }

    /// Returns the width. [px]
    pub fn width_px(&self) -> u32 {
        self.width_px
    }

    /// Returns the height. [px]
    pub fn height_px(&self) -> u32 {
        self.height_px
    }

    /// Returns the pixels, H x W.
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// Returns the pixels, H x W, mutably.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.pixels
    }

    /// Returns a pixel.
    ///
    /// # Panics
    /// If the pixel is outside the image.
    pub fn at(&self, x: u32, y: u32) -> u8 {
        assert!(x < self.width_px && y < self.height_px);
        self.pixels[y as usize * self.width_px as usize + x as usize]
    }
}

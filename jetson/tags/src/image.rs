//! A grey image.

/// A grey image, row by row from the top, without padding.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Gray {
    width_px: u32,
    height_px: u32,
    pixels: Vec<u8>,
}

impl Gray {
    /// Makes an image of one grey.
    pub fn plain(width_px: u32, height_px: u32, grey: u8) -> Self {
        Self { width_px, height_px, pixels: vec![grey; width_px as usize * height_px as usize] }
    }

    /// Makes an image of H x W pixels; `None` if their number is another.
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

    /// Returns the pixels, H x W, to be changed.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.pixels
    }

    /// Returns a pixel.
    ///
    /// # Panics
    /// If it is outside.
    pub fn at(&self, x: u32, y: u32) -> u8 {
        assert!(x < self.width_px && y < self.height_px);
        self.pixels[y as usize * self.width_px as usize + x as usize]
    }
}

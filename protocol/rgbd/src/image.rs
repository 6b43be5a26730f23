//! Input images and output buffers.

use core::ops::Range;

/// A row-major RGB-D image to encode. An empty slice omits its part.
#[derive(Clone, Copy, Debug)]
pub struct RgbdView<'a> {
    /// Width. [px]
    pub width: u32,
    /// Height. [px]
    pub height: u32,
    /// H x W x 3, or empty.
    pub rgb: &'a [u8],
    /// H x W camera-z depth, 0 for no return; or empty. [mm]
    pub depth_mm: &'a [u16],
}

/// A row-major image with any of the four parts to encode. An empty slice omits its part.
#[derive(Clone, Copy, Debug, Default)]
pub struct ImageView<'a> {
    /// Width. [px]
    pub width: u32,
    /// Height. [px]
    pub height: u32,
    /// H x W x 3, or empty.
    pub rgb: &'a [u8],
    /// H x W camera-z depth, 0 for no return; or empty. [mm]
    pub depth_mm: &'a [u16],
    /// H x W opacity, 255 is opaque; or empty.
    pub alpha: &'a [u8],
    /// H x W object ids, or empty.
    pub ids: &'a [u16],
}

impl<'a> From<&RgbdView<'a>> for ImageView<'a> {
    fn from(view: &RgbdView<'a>) -> Self {
        let &RgbdView { width, height, rgb, depth_mm } = view;
        Self { width, height, rgb, depth_mm, ..Self::default() }
    }
}

impl ImageView<'_> {
    /// Returns the parts of the image.
    pub fn parts(&self) -> Parts {
        Parts {
            color: !self.rgb.is_empty(),
            depth: !self.depth_mm.is_empty(),
            alpha: !self.alpha.is_empty(),
            ids: !self.ids.is_empty(),
        }
    }

    /// Returns a range of rows as an image.
    ///
    /// # Panics
    /// If a part does not contain these rows.
    pub fn rows(&self, rows: Range<u32>) -> Self {
        let width = self.width as usize;
        let pixels = rows.start as usize * width..rows.end as usize * width;
        Self {
            width: self.width,
            height: rows.end - rows.start,
            rgb: part(self.rgb, 3 * pixels.start..3 * pixels.end),
            depth_mm: part(self.depth_mm, pixels.clone()),
            alpha: part(self.alpha, pixels.clone()),
            ids: part(self.ids, pixels),
        }
    }
}

fn part<T>(all: &[T], range: Range<usize>) -> &[T] {
    if all.is_empty() { all } else { &all[range] }
}

/// Parts of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Parts {
    /// Whether the image has colour.
    pub color: bool,
    /// Whether the image has depth.
    pub depth: bool,
    /// Whether the image has opacity.
    pub alpha: bool,
    /// Whether the image has object ids.
    pub ids: bool,
}

/// Row-major buffers for a decoded image. An empty buffer skips its part.
#[derive(Debug, Default)]
pub struct ImageMut<'a> {
    /// H x W x 3, or empty.
    pub rgb: &'a mut [u8],
    /// H x W camera-z depth, 0 for no return; or empty. [mm]
    pub depth_mm: &'a mut [u16],
    /// H x W opacity, or empty.
    pub alpha: &'a mut [u8],
    /// H x W object ids, or empty.
    pub ids: &'a mut [u16],
}

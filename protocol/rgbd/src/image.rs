//! The pixels that go in, and the room that they come out into.

use core::ops::Range;

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

/// An image of any of the four parts to encode; row-major. An empty slice leaves that part out.
#[derive(Clone, Copy, Debug, Default)]
pub struct ImageView<'a> {
    /// Width. [px]
    pub width: u32,
    /// Height. [px]
    pub height: u32,
    /// H x W x 3, or empty.
    pub rgb: &'a [u8],
    /// H x W camera-z depth, 0 where there is no return; or empty. [mm]
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
    /// Returns what the image consists of.
    pub fn parts(&self) -> Parts {
        Parts {
            color: !self.rgb.is_empty(),
            depth: !self.depth_mm.is_empty(),
            alpha: !self.alpha.is_empty(),
            ids: !self.ids.is_empty(),
        }
    }

    /// Returns some rows as an image of their own.
    ///
    /// # Panics
    /// If a part that is there does not have these rows.
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

/// Which parts an image has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Parts {
    /// Colour.
    pub color: bool,
    /// Depth.
    pub depth: bool,
    /// Opacity.
    pub alpha: bool,
    /// Object ids.
    pub ids: bool,
}

/// Room for a decoded image; row-major. An empty slice leaves its part undecoded.
#[derive(Debug, Default)]
pub struct ImageMut<'a> {
    /// H x W x 3, or empty.
    pub rgb: &'a mut [u8],
    /// H x W camera-z depth, 0 where there is no return; or empty. [mm]
    pub depth_mm: &'a mut [u16],
    /// H x W opacity, or empty.
    pub alpha: &'a mut [u8],
    /// H x W object ids, or empty.
    pub ids: &'a mut [u16],
}

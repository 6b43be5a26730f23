//! Images of several channels as the passes write and read them: in bands as high as a tile, so that
//! threads own whole bands, padded to whole tiles.

/// Side of a tile. [px]
pub const TILE: usize = 16;

/// Channels of an image, band by band, channel by channel, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planes {
    /// Channels.
    pub channels: usize,
    /// Width of what counts. [px]
    pub width: usize,
    /// Height of what counts. [px]
    pub height: usize,
    /// Numbers from one row to the next: the width in whole tiles.
    pub stride: usize,
    /// All numbers.
    pub values: Vec<f32>,
}

impl Planes {
    /// Gives the planes a size; contents are unspecified, but zero where they are new.
    pub fn resize(&mut self, channels: usize, width: usize, height: usize) {
        self.channels = channels;
        self.width = width;
        self.height = height;
        self.stride = width.next_multiple_of(TILE);
        self.values.resize(self.bands() * self.band_len(), 0.0);
    }

    /// Returns the number of bands.
    pub fn bands(&self) -> usize {
        self.height.div_ceil(TILE)
    }

    /// Returns the numbers of a band.
    pub fn band_len(&self) -> usize {
        self.channels * TILE * self.stride
    }

    /// Returns where a row of a channel starts.
    fn start(&self, channel: usize, y: usize) -> usize {
        ((y / TILE * self.channels + channel) * TILE + y % TILE) * self.stride
    }

    /// Returns a row of a channel.
    pub fn row(&self, channel: usize, y: usize) -> &[f32] {
        &self.values[self.start(channel, y)..][..self.width]
    }

    /// Returns a row of a channel, to change.
    pub fn row_mut(&mut self, channel: usize, y: usize) -> &mut [f32] {
        let start = self.start(channel, y);
        let width = self.width;
        &mut self.values[start..][..width]
    }

    /// Returns one number.
    pub fn at(&self, channel: usize, x: usize, y: usize) -> f32 {
        self.values[self.start(channel, y) + x]
    }

    /// Returns one number, to change.
    pub fn at_mut(&mut self, channel: usize, x: usize, y: usize) -> &mut f32 {
        let start = self.start(channel, y);
        &mut self.values[start + x]
    }
}

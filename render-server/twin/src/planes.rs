//! Images of several channels, stored in bands of one tile's height and padded to whole tiles: each thread owns
//! complete bands.

/// Side of a tile. [px]
pub const TILE: usize = 16;

/// Channels of an image: band by band, channel by channel, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planes {
    /// Number of channels.
    pub channels: usize,
    /// Width without padding. [px]
    pub width: usize,
    /// Height without padding. [px]
    pub height: usize,
    /// Distance from one row to the next: the width rounded up to whole tiles.
    pub stride: usize,
    pub values: Vec<f32>,
}

impl Planes {
    /// Sets the size. Contents are unspecified; added values are zero.
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

    /// Returns the number of values in a band.
    pub fn band_len(&self) -> usize {
        self.channels * TILE * self.stride
    }

    /// Returns the index of a row's first value.
    fn start(&self, channel: usize, y: usize) -> usize {
        ((y / TILE * self.channels + channel) * TILE + y % TILE) * self.stride
    }

    /// Returns a row of a channel.
    pub fn row(&self, channel: usize, y: usize) -> &[f32] {
        &self.values[self.start(channel, y)..][..self.width]
    }

    /// Returns a mutable row of a channel.
    pub fn row_mut(&mut self, channel: usize, y: usize) -> &mut [f32] {
        let start = self.start(channel, y);
        let width = self.width;
        &mut self.values[start..][..width]
    }

    /// Returns one value.
    pub fn at(&self, channel: usize, x: usize, y: usize) -> f32 {
        self.values[self.start(channel, y) + x]
    }

    /// Returns one value for writing.
    pub fn at_mut(&mut self, channel: usize, x: usize, y: usize) -> &mut f32 {
        let start = self.start(channel, y);
        &mut self.values[start + x]
    }
}

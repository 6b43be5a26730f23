//! Decodes the images of a flight, one after the other.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use vizflyt_rgbd::{Decoder, peek};
use vizflyt_runtime::log::data::{FlightData, FlightDatum, FlightImage};
use vizflyt_runtime::log::read::LogReader;

/// Reader and decoder of images, which reuses its memory.
pub(super) struct Pictures {
    data: FlightData<BufReader<File>>,
    path: PathBuf,
    decoder: Decoder,
    /// Colours of the last returned image, H x W x 3, sRGB.
    pub(super) rgb: Vec<u8>,
    /// Depth of the last returned image, H x W, along the optical axis; 0: no depth. [mm, cam]
    pub(super) depth_mm: Vec<u16>,
    /// Number of images that do not decode.
    pub(super) broken: usize,
}

impl Pictures {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let reader =
            LogReader::open(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(Self {
            data: FlightData::new(reader, true),
            path: path.to_owned(),
            decoder: Decoder::new(),
            rgb: Vec::new(),
            depth_mm: Vec::new(),
            broken: 0,
        })
    }

    /// Returns the next image that `wants` accepts; `None` at the end. Its pixels are in [`Self::rgb`] and
    /// [`Self::depth_mm`].
    pub(super) fn next(
        &mut self,
        wants: impl Fn(&FlightImage) -> bool,
    ) -> Result<Option<FlightImage>> {
        loop {
            let datum =
                self.data.next().with_context(|| format!("cannot read {}", self.path.display()))?;
            let Some(datum) = datum else { return Ok(None) };
            let FlightDatum::Image(image) = datum else { continue };
            if !wants(&image) {
                continue;
            }
            if self.decode(&image).is_some() {
                return Ok(Some(image));
            }
            self.broken += 1;
        }
    }

    fn decode(&mut self, image: &FlightImage) -> Option<()> {
        let info = peek(&image.bitstream).ok()?;
        let size = (image.header.width_px.get(), image.header.height_px.get());
        if (info.width, info.height) != size {
            return None;
        }
        let pixels = info.width as usize * info.height as usize;
        self.rgb.clear();
        self.rgb.resize(3 * pixels, 0);
        self.depth_mm.clear();
        self.depth_mm.resize(pixels, 0);
        self.decoder.decode(&image.bitstream, &mut self.rgb, &mut self.depth_mm).ok()
    }

    /// Whether the last returned image has any depth. It has none if the course withholds depth.
    pub(super) fn has_depth(&self) -> bool {
        self.depth_mm.iter().any(|mm| *mm > 0)
    }
}

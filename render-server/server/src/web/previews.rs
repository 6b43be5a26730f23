//! The preview thread: small images of the rendered cameras, for the pages.
//!
//! Takes ticks from the encode thread ([`crate::render::rendered`]), newest-wins, at most [`PREVIEW_HZ`] per camera of
//! watched vehicles. Flying vehicles without a watcher get [`UNWATCHED_HZ`], for the crash card
//! ([`crate::flights::crash`]). An image of 640x480 costs 3 ms on this low-priority thread, most of it for the two
//! JPEGs of at most [`MAX_WIDTH_PX`].

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use tokio::sync::watch;
use tracing::warn;
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_arena::crash::ahead_m;
use vizflyt_protocol::messages::MAX_CAMERAS;
use vizflyt_rgbd::encode_jpeg;
use vizflyt_splat::{DepthKind, RgbdImage};

use crate::flights::Flights;
use crate::flights::recent_previews::Preview;
use crate::render::rendered::RenderQueue;
use crate::stop::Stop;
use crate::stream::subscriptions::Subscriptions;
use vizflyt_process::lock;

/// Newest previews, by vehicle and camera; newest-wins.
#[derive(Debug)]
pub struct Previews(Vec<Vec<watch::Sender<Option<Arc<Preview>>>>>);

impl Previews {
    /// Returns empty previews for vehicles with these numbers of cameras.
    pub fn new(cameras: &[usize]) -> Self {
        let of = |&count: &usize| (0..count).map(|_| watch::Sender::new(None)).collect();
        Self(cameras.iter().map(of).collect())
    }

    fn publish(&self, vehicle: usize, camera: usize, preview: Arc<Preview>) {
        if let Some(newest) = self.0.get(vehicle).and_then(|cameras| cameras.get(camera)) {
            newest.send_replace(Some(preview));
        }
    }

    /// Returns a receiver of each camera's newest preview.
    pub(super) fn subscribe(&self, vehicle: usize) -> Vec<watch::Receiver<Option<Arc<Preview>>>> {
        self.0[vehicle].iter().map(watch::Sender::subscribe).collect()
    }
}

/// Makes previews until the server stops.
pub fn run(
    previews: &Previews,
    flights: &Flights,
    subscriptions: &Subscriptions,
    ticks: &RenderQueue,
    stop: &Stop,
) {
    let mut stage = Stage::new();
    let mut turns = [[Turn { due: Instant::now(), seq: 0 }; MAX_CAMERAS]; MAX_VEHICLES];
    while !stop.is_set() {
        let Some(tick) = ticks.take_for_previews(PATIENCE) else { continue };
        let watched = subscriptions.watched();
        for slot in tick.slots.iter().filter(|slot| slot.fresh) {
            let vehicle = &flights.vehicles[slot.vehicle];
            let rate_hz = if watched[slot.vehicle] {
                PREVIEW_HZ
            } else if vehicle.under_way() {
                UNWATCHED_HZ
            } else {
                continue;
            };
            let turn = &mut turns[slot.vehicle][slot.camera];
            // A tick that the encode thread has skipped can overtake the one that it is encoding.
            if slot.seq <= turn.seq || !turn.comes(Instant::now(), rate_hz) {
                continue;
            }
            turn.seq = slot.seq;
            match stage.preview(&slot.image) {
                Ok(preview) => {
                    let preview = Arc::new(preview);
                    lock(&vehicle.previews).add(slot.camera, slot.shown, preview.clone());
                    previews.publish(slot.vehicle, slot.camera, preview);
                }
                Err(error) => warn!("{}: camera {}: {error:#}", vehicle.name, slot.camera),
            }
        }
    }
}

/// Due time of a camera's next preview, and number of the last image.
#[derive(Clone, Copy, Debug)]
struct Turn {
    due: Instant,
    seq: u64,
}

impl Turn {
    /// Whether a preview is due at `now`; if so, schedules the next one.
    fn comes(&mut self, now: Instant, rate_hz: u32) -> bool {
        let comes = now >= self.due;
        if comes {
            // Relative to the due time, to keep the mean rate; relative to now after a pause.
            self.due = (self.due + Duration::from_secs(1) / rate_hz).max(now);
        }
        comes
    }
}

/// Reused buffers.
struct Stage {
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
    coloured: Vec<u8>,
    small: Vec<u8>,
    nearest: Vec<u16>,
    /// Whether an object has been seen; otherwise no image of ids is sent.
    has_objects: bool,
    palette: Vec<[u8; 3]>,
}

impl Stage {
    fn new() -> Self {
        Self {
            rgb: Vec::new(),
            depth_mm: Vec::new(),
            coloured: Vec::new(),
            small: Vec::new(),
            nearest: Vec::new(),
            has_objects: false,
            palette: (0..PALETTE_SIZE).map(|k| depth_colour(palette_depth_mm(k))).collect(),
        }
    }

    fn preview(&mut self, image: &RgbdImage) -> Result<Preview> {
        image.write_rgb8(&mut self.rgb);
        image.write_depth_mm(DepthKind::Median, &mut self.depth_mm);
        let ahead_m = ahead_m(&self.depth_mm, image.width_px as usize, &mut self.nearest);
        self.coloured.clear();
        for &mm in &self.depth_mm {
            self.coloured.extend_from_slice(&self.palette[palette_index(mm)]);
        }
        let size = [image.width_px, image.height_px];
        let colour = jpeg(&self.rgb, size, &mut self.small)?;
        let depth = jpeg(&self.coloured, size, &mut self.small)?;
        self.has_objects |= image.ids.iter().any(|&id| id != 0);
        let mut ids = Vec::new();
        if self.has_objects {
            self.coloured.clear();
            for (&id, &mm) in image.ids.iter().zip(&self.depth_mm) {
                self.coloured.extend_from_slice(&id_colour(id, mm));
            }
            ids = jpeg(&self.coloured, size, &mut self.small)?;
        }
        Ok(Preview { colour, depth, ids, ahead_m })
    }
}

fn jpeg(rgb: &[u8], size: [u32; 2], small: &mut Vec<u8>) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let [width, height] = shrink(rgb, size, small);
    encode_jpeg(small, width, height, PREVIEW_QUALITY, &mut out).context("no preview")?;
    Ok(out)
}

/// Writes `rgb` to `small`, at most [`MAX_WIDTH_PX`] wide, and returns the new width and height. Each pixel is the mean
/// of the pixels that it covers.
fn shrink(rgb: &[u8], [width, height]: [u32; 2], small: &mut Vec<u8>) -> [u32; 2] {
    small.clear();
    if width <= MAX_WIDTH_PX {
        small.extend_from_slice(rgb);
        return [width, height];
    }
    let new_height = (height * MAX_WIDTH_PX / width).max(1);
    // Range of pixels along a row or column of `old` that pixel `at` of `new` covers.
    let covered = |at: u32, new: u32, old: u32| {
        (at * old / new) as usize..((at + 1) * old).div_ceil(new) as usize
    };
    for y in 0..new_height {
        let rows = covered(y, new_height, height);
        for x in 0..MAX_WIDTH_PX {
            let columns = covered(x, MAX_WIDTH_PX, width);
            let mut sum = [0u32; 3];
            for row in rows.clone() {
                let start = row * width as usize;
                let run = &rgb[(start + columns.start) * 3..(start + columns.end) * 3];
                for pixel in run.chunks_exact(3) {
                    for (sum, &value) in sum.iter_mut().zip(pixel) {
                        *sum += u32::from(value);
                    }
                }
            }
            let count = (rows.len() * columns.len()) as u32;
            small.extend(sum.map(|sum| ((sum + count / 2) / count) as u8));
        }
    }
    [MAX_WIDTH_PX, new_height]
}

/// Returns the colour of a depth on the page: pale near, dark far, logarithmic from 0.3 to 20 m; black without a
/// return. The page's legend uses the same stops.
pub fn depth_colour(depth_mm: u16) -> [u8; 3] {
    if depth_mm == 0 {
        return [0; 3];
    }
    let share = (f32::from(depth_mm) / NEAR_MM).ln() / (FAR_MM / NEAR_MM).ln();
    let at = share.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    let index = (at as usize).min(STOPS.len() - 2);
    let t = at - index as f32;
    let mix = |a: u8, b: u8| (f32::from(a) + (f32::from(b) - f32::from(a)) * t).round() as u8;
    let (a, b) = (STOPS[index], STOPS[index + 1]);
    [mix(a[0], b[0]), mix(a[1], b[1]), mix(a[2], b[2])]
}

/// Returns the colour of an object on the page, by its id; the static scene is grey, darker with depth.
pub fn id_colour(id: u16, depth_mm: u16) -> [u8; 3] {
    match id {
        0 => {
            let [r, g, b] = depth_colour(depth_mm).map(u16::from);
            [((r + g + b) / 9) as u8; 3]
        }
        id => IDS[usize::from(id - 1) % IDS.len()],
    }
}

/// Colours that can be distinguished with any colour vision (Okabe and Ito, 2008).
const IDS: [[u8; 3]; 7] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [0, 114, 178],
    [213, 94, 0],
    [204, 121, 167],
];

/// Index by depth in steps of 16 mm; 0 is no return.
fn palette_index(mm: u16) -> usize {
    if mm == 0 { 0 } else { 1 + usize::from(mm >> 4) }
}

fn palette_depth_mm(index: usize) -> u16 {
    if index == 0 { 0 } else { (((index - 1) << 4) + 8) as u16 }
}

const PALETTE_SIZE: usize = 1 + (1 << 12);
const STOPS: [[u8; 3]; 5] =
    [[255, 244, 191], [255, 173, 79], [232, 72, 108], [125, 47, 147], [31, 24, 80]];
const NEAR_MM: f32 = 300.0;
const FAR_MM: f32 = 20_000.0;
/// Sufficient for watching, at half the cost of 30 Hz. [Hz]
pub const PREVIEW_HZ: u32 = 15;
/// Ten images of the two seconds before a crash; 1.5 % of a core per camera. [Hz]
const UNWATCHED_HZ: u32 = 5;
const PREVIEW_QUALITY: u8 = 80;
/// Wider than a camera on the page. [px]
const MAX_WIDTH_PX: u32 = 480;
/// Maximum delay until a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_colours_run_from_pale_to_dark_and_no_return_is_black() {
        assert_eq!(depth_colour(0), [0; 3]);
        assert_eq!(depth_colour(300), STOPS[0]);
        assert_eq!(depth_colour(1), STOPS[0]);
        assert_eq!(depth_colour(u16::MAX), STOPS[4]);
        let light = |mm| depth_colour(mm).iter().map(|&c| u32::from(c)).sum::<u32>();
        let depths = [300u16, 600, 1200, 2400, 5000, 10_000, 20_000];
        assert!(depths.is_sorted_by_key(|&mm| std::cmp::Reverse(light(mm))));
    }

    #[test]
    fn the_palette_agrees_with_the_colours() {
        let palette: Vec<_> =
            (0..PALETTE_SIZE).map(|k| depth_colour(palette_depth_mm(k))).collect();
        for mm in 0..=u16::MAX {
            let (found, expected) = (palette[palette_index(mm)], depth_colour(mm));
            let off = found.iter().zip(expected).map(|(a, b)| a.abs_diff(b)).max();
            assert!(off.is_some_and(|off| off <= 8), "{mm} mm: {found:?} for {expected:?}");
        }
    }

    #[test]
    fn sends_ids_once_an_object_was_seen() {
        let image = |id: u16| RgbdImage {
            width_px: 16,
            height_px: 16,
            rgb: vec![0.5; 16 * 16 * 3],
            alpha: vec![1.0; 256],
            depth_expected_m: vec![2.0; 256],
            depth_median_m: vec![2.0; 256],
            ids: vec![id; 256],
        };
        let mut stage = Stage::new();
        assert!(stage.preview(&image(0)).unwrap().ids.is_empty());
        assert!(!stage.preview(&image(3)).unwrap().ids.is_empty());
        // Also when the object is out of sight, so that the page does not keep the last image.
        assert!(!stage.preview(&image(0)).unwrap().ids.is_empty());
        assert_eq!(id_colour(1, 0), id_colour(8, 9000), "colours repeat");
        assert_ne!(id_colour(1, 0), id_colour(2, 0));
        assert_eq!(id_colour(0, 0), [0; 3]);
    }

    fn check_shrunk(width: u32, height: u32, expected: [u32; 2]) {
        // A ramp along each axis stays a ramp under any box mean.
        let value = |at: u32, of: u32| (255 * at / of) as u8;
        let pixel = |k: u32| [value(k % width, width), value(k / width, height), 7];
        let rgb: Vec<u8> = (0..width * height).flat_map(pixel).collect();
        let mut small = Vec::new();
        let size = shrink(&rgb, [width, height], &mut small);
        assert_eq!(size, expected);
        assert_eq!(small.len() as u32, size[0] * size[1] * 3);
        for (k, pixel) in small.chunks_exact(3).enumerate() {
            let middle = |at: u32, of: u32| 255.0 * (f64::from(at) + 0.5) / f64::from(of);
            let (x, y) = (k as u32 % size[0], k as u32 / size[0]);
            assert!((f64::from(pixel[0]) - middle(x, size[0])).abs() < 2.0, "{k}: {pixel:?}");
            let slope = 255.0 / f64::from(size[1]);
            assert!((f64::from(pixel[1]) - middle(y, size[1])).abs() < 2.0 + slope, "{k}");
            assert_eq!(pixel[2], 7);
        }
    }

    #[test]
    fn previews_are_shrunk_to_the_pages_width() {
        check_shrunk(480, 360, [480, 360]);
        check_shrunk(640, 480, [480, 360]);
        check_shrunk(481, 300, [480, 299]);
        check_shrunk(3840, 2160, [480, 270]);
        check_shrunk(4096, 1, [480, 1]);
    }

    #[test]
    fn keeps_the_rate_and_is_due_at_once_after_a_pause() {
        let start = Instant::now();
        let mut turn = Turn { due: start, seq: 0 };
        let at = |ms: u64| start + Duration::from_millis(ms);
        let turns = (0..1000).filter(|&ms| turn.comes(at(ms), PREVIEW_HZ)).count();
        assert!(turns.abs_diff(PREVIEW_HZ as usize) <= 1, "{turns}");
        assert!(turn.comes(at(5000), PREVIEW_HZ));
    }
}

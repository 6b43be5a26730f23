//! Comparison of this crate with other codecs, in one run: milliseconds per 640x480 image on one core, bits per pixel,
//! PSNR, and bandwidth of a camera of this size at 100 Hz.
//!
//! ```text
//! cargo bench -p vizflyt-rgbd [--features turbo] [-- FILTER]
//! ```
//!
//! Times are lower quartiles of [`ROUNDS`] rounds. Each round runs every codec once, so that a busy machine slows all
//! of them equally: compare only figures of the same run. Times of smaller images are scaled to 640x480 by their
//! pixels. FILTER selects codecs whose name contains it.

mod images;
mod peers;
mod rvl;

use std::time::Instant;

use images::Image;
use jpeg_encoder::SamplingFactor;
use peers::{Codec, Given, Lz4, Ours, Png16, PureJpeg, Qoi, Rvl, Zstd};
use vizflyt_rgbd::{ColorMode, DepthBound, DepthMode, EncodeOptions};

/// Number of rounds of every codec.
const ROUNDS: usize = 24;
/// Number of pixels of the reference image size.
const VGA: f64 = 640.0 * 480.0;

/// A codec with its name, and whether it is lossless.
struct Entry {
    name: &'static str,
    given: Given,
    exact: bool,
    codec: Box<dyn Codec>,
}

/// Results of one codec for one image.
#[derive(Default)]
struct Figures {
    encode_ms: Vec<f64>,
    decode_ms: Vec<f64>,
    bytes: usize,
    psnr_db: f64,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    // `cargo test` also runs benches, but without this flag: nothing to test here.
    if !arguments.iter().any(|argument| argument == "--bench") {
        return;
    }
    let filter = arguments.iter().find(|argument| !argument.starts_with("--"));
    let mut entries = entries();
    entries.retain(|entry| filter.is_none_or(|filter| entry.name.contains(filter.as_str())));
    for (group, images) in images::groups() {
        println!("\n{group}, {} images", images.len());
        println!(
            "{:40} {:>9} {:>9} {:>7} {:>8} {:>8} {:>10}",
            "", "encode ms", "decode ms", "bpp", "dB mean", "dB least", "Mbit/100Hz"
        );
        let figures: Vec<Vec<Figures>> =
            images.iter().map(|image| measure(image, &mut entries)).collect();
        for (n, entry) in entries.iter().enumerate() {
            let of = |value: &dyn Fn(&Figures) -> f64| {
                figures.iter().map(|all| value(&all[n])).sum::<f64>() / figures.len() as f64
            };
            let least = figures.iter().map(|all| all[n].psnr_db).fold(f64::INFINITY, f64::min);
            let bpp = figures
                .iter()
                .zip(&images)
                .map(|(all, image)| all[n].bytes as f64 * 8.0 / image.depth_mm.len() as f64)
                .sum::<f64>()
                / figures.len() as f64;
            let decibels = |value: f64| {
                if entry.given == Given::Depth { String::new() } else { format!("{value:.1}") }
            };
            println!(
                "{:40} {:>9.2} {:>9.2} {:>7.2} {:>8} {:>8} {:>10.0}",
                entry.name,
                of(&|figures| lower_quartile(&figures.encode_ms)),
                of(&|figures| lower_quartile(&figures.decode_ms)),
                bpp,
                decibels(of(&|figures| figures.psnr_db)),
                decibels(least),
                bpp * VGA * 100.0 / 1e6,
            );
        }
    }
}

/// Encodes and decodes an image with every codec in turn.
fn measure(image: &Image, entries: &mut [Entry]) -> Vec<Figures> {
    let (width, height, pixels) = (image.width, image.height, image.depth_mm.len());
    let mut back = Image { width, height, rgb: vec![0; 3 * pixels], depth_mm: vec![0; pixels] };
    let scale = 1e3 * VGA / pixels as f64;
    let mut all: Vec<Figures> = entries.iter().map(|_| Figures::default()).collect();
    // The first round warms up.
    for round in 0..=ROUNDS {
        for (entry, figures) in entries.iter_mut().zip(&mut all) {
            let start = Instant::now();
            let bytes = entry.codec.encode(image);
            let encoded = Instant::now();
            entry.codec.decode(&mut back);
            let decoded = Instant::now();
            if round > 0 {
                figures.encode_ms.push((encoded - start).as_secs_f64() * scale);
                figures.decode_ms.push((decoded - encoded).as_secs_f64() * scale);
                continue;
            }
            figures.bytes = bytes;
            if entry.given != Given::Depth {
                figures.psnr_db = psnr_db(&image.rgb, &back.rgb);
            }
            if entry.exact {
                let same = match entry.given {
                    Given::Color => back.rgb == image.rgb,
                    Given::Depth | Given::Both => back.depth_mm == image.depth_mm,
                };
                assert!(same, "{} is not exact", entry.name);
            } else if entry.given != Given::Color {
                for (&truth, &decoded) in image.depth_mm.iter().zip(&back.depth_mm) {
                    assert_eq!(truth == 0, decoded == 0, "{}", entry.name);
                    let error_mm = truth.abs_diff(decoded);
                    assert!(error_mm <= bound().error_mm(truth), "{}: {truth}", entry.name);
                }
            }
        }
    }
    all
}

fn bound() -> DepthBound {
    DepthBound::new(0.001).expect("a bound")
}

fn entries() -> Vec<Entry> {
    let default = EncodeOptions::default();
    let small = EncodeOptions { depth_mode: DepthMode::Small, ..default };
    let bounded = EncodeOptions { depth_bound: Some(bound()), ..default };
    let bounded_small = EncodeOptions { depth_bound: Some(bound()), ..small };
    let colour = |color_mode| EncodeOptions { color_mode, ..default };
    let mut entries = Vec::new();
    let mut add = |name, given, exact, codec: Box<dyn Codec>| {
        entries.push(Entry { name, given, exact, codec });
    };
    let ours = |given, options| Box::new(Ours::new(given, options));
    add("depth: RVL", Given::Depth, true, Box::<Rvl>::default());
    add("depth: zstd 1", Given::Depth, true, Box::new(Zstd::new(Given::Depth)));
    add("depth: lz4", Given::Depth, true, Box::new(Lz4::new(Given::Depth)));
    add("depth: PNG 16 bit", Given::Depth, true, Box::<Png16>::default());
    add("depth: ours fast", Given::Depth, true, ours(Given::Depth, default));
    add("depth: ours small", Given::Depth, true, ours(Given::Depth, small));
    add("depth: ours bounded fast 0.001", Given::Depth, false, ours(Given::Depth, bounded));
    add("depth: ours bounded small 0.001", Given::Depth, false, ours(Given::Depth, bounded_small));
    add("colour: zstd 1", Given::Color, true, Box::new(Zstd::new(Given::Color)));
    add("colour: lz4", Given::Color, true, Box::new(Lz4::new(Given::Color)));
    add("colour: QOI", Given::Color, true, Box::<Qoi>::default());
    let pure = |sampling| Box::new(PureJpeg::new(sampling));
    let (full, half) = (SamplingFactor::R_4_4_4, SamplingFactor::R_4_2_0);
    add("colour: jpeg-encoder, zune-jpeg 4:4:4 q93", Given::Color, false, pure(full));
    add("colour: jpeg-encoder, zune-jpeg 4:2:0 q93", Given::Color, false, pure(half));
    #[cfg(feature = "turbo")]
    {
        use peers::TurboJpeg;
        use turbojpeg::Subsamp::{None, Sub2x2};
        let turbo = |subsamp| Box::new(TurboJpeg::new(subsamp));
        add("colour: libjpeg-turbo 4:4:4 q93", Given::Color, false, turbo(None));
        add("colour: libjpeg-turbo 4:2:0 q93", Given::Color, false, turbo(Sub2x2));
    }
    let (full, half) = (colour(ColorMode::Jpeg444), colour(ColorMode::Jpeg420));
    let exact = colour(ColorMode::Lossless);
    add("colour: ours 4:4:4 q93", Given::Color, false, ours(Given::Color, full));
    add("colour: ours 4:2:0 q93", Given::Color, false, ours(Given::Color, half));
    add("colour: ours lossless", Given::Color, true, ours(Given::Color, exact));
    add("RGB-D: 4:4:4 q93, fast", Given::Both, true, ours(Given::Both, default));
    add("RGB-D: 4:4:4 q93, small", Given::Both, true, ours(Given::Both, small));
    add("RGB-D: 4:4:4 q93, bounded fast", Given::Both, false, ours(Given::Both, bounded));
    add("RGB-D: 4:4:4 q93, bounded small", Given::Both, false, ours(Given::Both, bounded_small));
    let lesser = EncodeOptions { jpeg_quality: 88, ..bounded };
    add("RGB-D: 4:4:4 q88, bounded fast", Given::Both, false, ours(Given::Both, lesser));
    let least = EncodeOptions { jpeg_quality: 86, slices: 1, ..bounded_small };
    add("RGB-D: 4:4:4 q86, bounded small, 1 slice", Given::Both, false, ours(Given::Both, least));
    let everything = EncodeOptions { color_mode: ColorMode::Lossless, ..small };
    add("RGB-D: lossless, small", Given::Both, true, ours(Given::Both, everything));
    entries
}

/// Lower quartile, which other load on the machine disturbs less than the median.
fn lower_quartile(times: &[f64]) -> f64 {
    let mut times = times.to_vec();
    times.sort_by(f64::total_cmp);
    times[times.len() / 4]
}

fn psnr_db(a: &[u8], b: &[u8]) -> f64 {
    let squares: u64 = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2)).sum();
    10.0 * (255.0f64.powi(2) / (squares as f64 / a.len() as f64)).log10()
}

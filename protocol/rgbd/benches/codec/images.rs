//! Benchmark images: the demo forest, captured scenes, and both with a depth camera's noise.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use vizflyt_rgbd::{Decoder, ImageMut, peek};

/// Pixels of an image.
pub(crate) struct Image {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) rgb: Vec<u8>,
    pub(crate) depth_mm: Vec<u16>,
}

/// Returns the groups of images with their names.
pub(crate) fn groups() -> Vec<(&'static str, Vec<Image>)> {
    let mut groups = vec![("demo forest", vec![forest()])];
    let captured = captured();
    if !captured.is_empty() {
        groups.push(("captured scenes", captured));
    }
    let noisy: Vec<Image> = groups.iter().flat_map(|(_, images)| images).map(with_noise).collect();
    groups.push(("all, depth noisy", noisy));
    groups
}

/// The demo's forest, seed 7, from the start: rendered by `vizflyt-splat` at 640x480 with a field of view of 90
/// degrees, stored in this crate's lossless modes.
fn forest() -> Image {
    let bytes = include_bytes!("forest.vzrd");
    let info = peek(bytes).expect("a whole file");
    let pixels = info.width as usize * info.height as usize;
    let (mut rgb, mut depth_mm) = (vec![0; 3 * pixels], vec![0; pixels]);
    let mut room = ImageMut { rgb: &mut rgb, depth_mm: &mut depth_mm, ..ImageMut::default() };
    Decoder::new().decode_image(bytes, &mut room).expect("a whole file");
    Image { width: info.width, height: info.height, rgb, depth_mm }
}

/// Captured scenes, rendered by the oracle in `../shared` at its reference poses, if present.
fn captured() -> Vec<Image> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes/ref");
    let names = [
        ("room_p0_640x480", 640, 480),
        ("room_p1_320x240", 320, 240),
        ("flowers_lod2_p0_320x240", 320, 240),
        ("flowers_lod2_p1_320x240", 320, 240),
    ];
    let mut images = Vec::new();
    for (name, width, height) in names {
        let path = folder.join(name).with_extension("npz");
        let Ok(file) = File::open(&path) else {
            println!("skipped: {name}, for lack of {}", path.display());
            continue;
        };
        let mut arrays = zip::ZipArchive::new(file).expect("an archive of arrays");
        let mut floats = |name: &str| {
            let mut bytes = Vec::new();
            arrays.by_name(name).expect("the array").read_to_end(&mut bytes).expect("whole");
            // Magic and version, eight bytes; length of the header; the header.
            let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
            let (floats, _) = bytes[start..].as_chunks();
            floats.iter().map(|float| f32::from_le_bytes(*float)).collect::<Vec<f32>>()
        };
        let (rgb, alpha, depth_m) =
            (floats("rgb.npy"), floats("alpha.npy"), floats("depth_median.npy"));
        assert_eq!(depth_m.len(), (width * height) as usize);
        images.push(Image {
            width,
            height,
            rgb: rgb.iter().map(|value| (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect(),
            depth_mm: depth_m
                .iter()
                .zip(&alpha)
                .map(|(&m, &alpha)| {
                    let mm = m * 1000.0 + 0.5;
                    if alpha >= 0.5 && mm < 65536.0 { mm as u16 } else { 0 }
                })
                .collect(),
        });
    }
    images
}

/// Adds Gaussian noise of 1 mm + 1.425 mm z^2, z in metres (Khoshelham and Elberink, Sensors 2012, for a
/// structured-light camera), and invalidates one pixel in 500.
fn with_noise(image: &Image) -> Image {
    let mut state = 7u64;
    let mut uniform = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as f64 / (1u64 << 31) as f64
    };
    let depth_mm = image.depth_mm.iter().map(|&mm| {
        // Twelve uniform numbers minus six: close to a normal distribution.
        let normal = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        let z = f64::from(mm) / 1000.0;
        if mm == 0 || uniform() < 0.002 {
            return 0;
        }
        (f64::from(mm) + (1.0 + 1.425 * z * z) * normal).round().clamp(1.0, 65535.0) as u16
    });
    let &Image { width, height, .. } = image;
    Image { width, height, rgb: image.rgb.clone(), depth_mm: depth_mm.collect() }
}

//! Tests against other decoders, the definition of the inverse DCT, and damaged scans.

use jpeg_encoder::{ColorType, SamplingFactor};
use proptest::prelude::*;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;

use super::transform::{Basis, double_row, samples};
use super::*;
use crate::color::jpeg::Layout;

/// Pixels that need many bits or few bits in a scan, depending on `grain`.
fn pixels(width: usize, height: usize, seed: u64, grain: u32) -> Vec<u8> {
    let mut state = seed;
    let mut pixels = Vec::new();
    for at in 0..width * height {
        let (x, y) = ((at % width) as f64, (at / width) as f64);
        for channel in 0..3 {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let noise = f64::from((state >> 40) as u32 % (2 * grain + 1)) - f64::from(grain);
            let wave = (x * 0.13 + f64::from(channel)).sin() * (y * 0.09 + seed as f64 % 7.0).cos();
            pixels.push((128.0 + 140.0 * wave + noise) as u8);
        }
    }
    pixels
}

#[derive(Clone, Copy, Debug)]
struct Made {
    width: u16,
    height: u16,
    quality: u8,
    halved: bool,
}

fn jpeg(rgb: &[u8], made: Made) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut jpeg, made.quality);
    let factor = if made.halved { SamplingFactor::R_4_2_0 } else { SamplingFactor::R_4_4_4 };
    encoder.set_sampling_factor(factor);
    encoder.encode(rgb, made.width, made.height, ColorType::Rgb).unwrap();
    jpeg
}

fn split(jpeg: &[u8]) -> (&[u8], &[u8]) {
    jpeg.split_at(Layout::of(jpeg).unwrap().scan)
}

fn decode(jpeg: &[u8], width: u16, height: u16) -> Result<Vec<u8>, DecodeError> {
    let (tables, scan) = split(jpeg);
    let mut decoder = JpegSliceDecoder::default();
    decoder.start(tables, u32::from(width))?;
    let mut rgb = vec![0; 3 * usize::from(width) * usize::from(height)];
    decoder.decode(scan, (u32::from(width), u32::from(height)), &mut rgb)?;
    Ok(rgb)
}

/// Decodes with zune-jpeg.
fn reference(jpeg: &[u8]) -> Vec<u8> {
    JpegDecoder::new(ZCursor::new(jpeg)).decode().unwrap()
}

fn farthest(a: &[u8], b: &[u8]) -> u8 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

fn made() -> impl Strategy<Value = Made> {
    (1u16..70, 1u16..70, 1u8..=100, any::<bool>())
        .prop_map(|(width, height, quality, halved)| Made { width, height, quality, halved })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn decodes_the_same_as_zune_jpeg(made in made(), seed: u64, grain in 0u32..200) {
        let rgb = pixels(made.width.into(), made.height.into(), seed, grain);
        let jpeg = jpeg(&rgb, made);
        let ours = decode(&jpeg, made.width, made.height).unwrap();
        let reference = reference(&jpeg);
        if made.halved {
            // Outside its own blocks, zune-jpeg smooths chroma differently.
            let off = ours.iter().zip(&reference).map(|(a, b)| u64::from(a.abs_diff(*b)));
            let mean = off.sum::<u64>() as f64 / ours.len() as f64;
            prop_assert!(mean < 2.0 || made.width.min(made.height) < 24, "off by {mean}");
        } else {
            let off = farthest(&ours, &reference);
            prop_assert!(off <= 2, "off by {off}");
        }
    }

    /// The instruction set makes no difference, also for damaged scans.
    #[test]
    fn plain_and_wide_decoders_agree(
        made in made(), seed: u64, grain in 0u32..200,
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..3),
    ) {
        let rgb = pixels(made.width.into(), made.height.into(), seed, grain);
        let mut jpeg = jpeg(&rgb, made);
        let start = split(&jpeg).0.len();
        jpeg.truncate(jpeg.len() - 2);
        for (at, byte) in damage {
            let at = start + at.index(jpeg.len() - start);
            jpeg[at] = byte;
        }
        let (tables, scan) = split(&jpeg);
        let tables = Tables::read(tables).unwrap();
        let (mut wide, mut plain) = (vec![0; rgb.len()], vec![0; rgb.len()]);
        let found = decode_scan(&tables, &mut Scratch::default(), scan, &mut wide);
        let expected = decode_scan_here(&tables, &mut Scratch::default(), scan, &mut plain);
        prop_assert_eq!(found, expected);
        prop_assert!(wide == plain);
    }

    #[test]
    fn does_not_panic_on_damaged_tables(
        at in any::<prop::sample::Index>(), byte: u8, cut in any::<prop::sample::Index>(),
        scan in prop::collection::vec(any::<u8>(), 0..300), halved: bool,
    ) {
        let made = Made { width: 20, height: 20, quality: 80, halved };
        let jpeg = jpeg(&pixels(20, 20, 1, 20), made);
        let mut tables = split(&jpeg).0.to_vec();
        prop_assert!(Tables::read(&tables[..cut.index(tables.len())]).is_err());
        let at = at.index(tables.len());
        tables[at] = byte;
        if let Ok(tables) = Tables::read(&tables) {
            let mut out = vec![0; 3 * usize::from(tables.width) * 20];
            if !out.is_empty() {
                let _ = decode_scan(&tables, &mut Scratch::default(), &scan, &mut out);
            }
        }
    }
}

/// Comparison with libjpeg-turbo as encoder and decoder, also with optimized Huffman tables.
#[cfg(feature = "turbo")]
#[test]
fn libjpeg_turbo_decodes_the_same() {
    use turbojpeg::{Image, PixelFormat, Subsamp};
    for (quality, grain) in [(30, 9), (93, 20), (93, 200), (100, 200)] {
        for subsamp in [Subsamp::None, Subsamp::Sub2x2] {
            for (width, height) in [(640usize, 120usize), (61, 43), (5, 1), (6, 17)] {
                let rgb = pixels(width, height, 5, grain);
                let pitch = 3 * width;
                let image = Image { pixels: &*rgb, width, pitch, height, format: PixelFormat::RGB };
                let mut compressor = turbojpeg::Compressor::new().unwrap();
                compressor.set_quality(quality).unwrap();
                compressor.set_subsamp(subsamp).unwrap();
                compressor.set_optimize(grain > 20).unwrap();
                let jpeg = compressor.compress_to_vec(image).unwrap();
                let theirs = turbojpeg::decompress(&jpeg, PixelFormat::RGB).unwrap().pixels;
                let ours = decode(&jpeg, width as u16, height as u16).unwrap();
                let off = farthest(&ours, &theirs);
                assert!(off <= 3, "off by {off}: {width}x{height} {subsamp:?} {quality} {grain}");
            }
        }
    }
}

/// Inverse DCT by T.81, A.3.3, term by term.
fn inverse_dct(coefficients: &[[f64; 8]; 8]) -> [[f64; 8]; 8] {
    let part = |frequency: usize, at: usize| {
        let weight = if frequency == 0 { 0.5f64.sqrt() } else { 1.0 };
        let angle = (2 * at + 1) as f64 * frequency as f64 * std::f64::consts::PI / 16.0;
        0.5 * weight * angle.cos()
    };
    let both = |y, x| {
        let all = (0..64).map(|at| (at / 8, at % 8));
        all.map(|(v, u)| coefficients[v][u] * part(v, y) * part(u, x)).sum()
    };
    std::array::from_fn(|y| std::array::from_fn(|x| both(y, x)))
}

/// Similar to IEEE 1180: many blocks, each compared with the sum of all basis functions.
#[test]
fn inverse_dct_matches_the_standard() {
    let zigzag = zigzag();
    let basis = Basis::new(&[1; 64]);
    let mut state = 1u64;
    let mut next = |range: i32| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as i32 % (2 * range + 1) - range
    };
    for range in [5, 40, 300] {
        let (mut error, mut squares, mut peak) = (0.0, 0.0, 0.0f64);
        let blocks = 2000;
        for _ in 0..blocks {
            let mut coefficients = [[0.0; 8]; 8];
            let mut rows = basis.start(0);
            for (at, &(v, u)) in zigzag.iter().enumerate() {
                let number = next(range / (1 + (at / 4) as i32));
                coefficients[v][u] = f64::from(number);
                basis.add(&mut rows, at, number);
            }
            let ours = samples(&rows);
            let exact = inverse_dct(&coefficients);
            for (ours, exact) in ours.as_flattened().iter().zip(exact.as_flattened()) {
                let off = f64::from(*ours) / 16.0 - (exact + 128.0).clamp(0.0, 255.0);
                (error, squares, peak) = (error + off, squares + off * off, peak.max(off.abs()));
            }
        }
        let n = f64::from(64 * blocks);
        // In sixteenths: the rounding error is at most a half, with a mean square of a twelfth.
        let (peak, squares, error) = (16.0 * peak, 256.0 * squares / n, 16.0 * error / n);
        assert!(peak < 0.51, "{peak} at {range}");
        assert!(squares < 0.085 && error.abs() < 0.01, "{squares}, {error} at {range}");
    }
    for dc in [-1200, -8, 0, 7, 1016, 4000] {
        let exact = (16 * 128 + 2 * dc).clamp(0, 16 * 255) as u16;
        assert_eq!(samples(&basis.start(dc)), [[exact; 8]; 8]);
    }
}

#[test]
fn chroma_upsampling_is_a_triangle_filter() {
    for len in 1..70 {
        let row = |seed: usize| -> Vec<Sample> {
            (0..len).map(|at| ((at * 7919 + seed) * at % 4081) as Sample).collect()
        };
        let (near, far) = (row(11), row(500));
        let (mut sums, mut out) = (vec![0; len + 2], vec![0; 2 * len]);
        double_row(&near, &far, &mut sums, &mut out);
        for (x, &found) in out.iter().enumerate() {
            let (own, side) =
                (x / 2, if x % 2 == 0 { (x / 2).saturating_sub(1) } else { x / 2 + 1 });
            let sum = |at: usize| 0.75 * f64::from(near[at]) + 0.25 * f64::from(far[at]);
            let expected = 0.75 * sum(own) + 0.25 * sum(side.min(len - 1));
            assert!((f64::from(found) - expected).abs() <= 0.5, "{x} of {len}: {found}");
        }
    }
}

/// Row and column of each coefficient in zigzag order.
fn zigzag() -> Vec<(usize, usize)> {
    let mut all: Vec<_> = (0..64).map(|at| (at / 8, at % 8)).collect();
    all.sort_by_key(|&(v, u)| (v + u, if (v + u) % 2 == 0 { u } else { v }));
    all
}

#[test]
fn rejects_truncated_and_extended_scans() {
    for halved in [false, true] {
        let made = Made { width: 21, height: 18, quality: 90, halved };
        let jpeg = jpeg(&pixels(21, 18, 3, 30), made);
        let (tables, scan) = split(&jpeg);
        let entropy = &scan[..scan.len() - 2];
        let mut decoder = JpegSliceDecoder::default();
        decoder.start(tables, 21).unwrap();
        let mut out = vec![0; 3 * 21 * 18];
        let mut refused = |bytes: &[u8]| {
            let scan = [bytes, &[0xff, 0xd9]].concat();
            match decoder.decode(&scan, (21, 18), &mut out) {
                Err(DecodeError::Color(why)) => why,
                other => panic!("{other:?}"),
            }
        };
        let mut whys = std::collections::BTreeSet::new();
        for len in 0..entropy.len() {
            whys.insert(refused(&entropy[..len]));
            let marker = [&entropy[..len], &[0xff, 0xd0], &entropy[len..]].concat();
            // In the padding, 0xff and the inserted marker also form a marker.
            assert_eq!(refused(&marker), "a scan has a marker inside", "at {len}");
        }
        assert!(whys.iter().any(|why| why == "a scan ends before its pixels do"), "{whys:?}");
        let longer = |more: &[u8]| [entropy, more].concat();
        assert_eq!(refused(&longer(&[0])), "a scan goes on after its pixels");
        assert_eq!(refused(&longer(&[0xff, 0])), "a scan goes on after its pixels");
        assert_eq!(refused(&longer(&[0xff, 0xd8, 0])), "a scan has a marker inside");
        assert!(decoder.decode(scan, (21, 18), &mut out).is_ok(), "a decoder outlives errors");
        assert!(decoder.decode(entropy, (21, 18), &mut out).is_err(), "an end is missing");
    }
}

#[test]
fn uses_the_tables_of_the_latest_start() {
    let mut decoder = JpegSliceDecoder::default();
    let refused = decoder.decode(&END_OF_IMAGE, (21, 18), &mut [0; 3 * 21 * 18]);
    assert_eq!(refused, Err(damaged("it has no tables")));
    for (quality, halved) in [(90, false), (90, false), (20, false), (20, true), (90, false)] {
        let made = Made { width: 21, height: 18, quality, halved };
        let jpeg = jpeg(&pixels(21, 18, 3, 30), made);
        let (tables, scan) = split(&jpeg);
        decoder.start(tables, 21).unwrap();
        let mut out = vec![0; 3 * 21 * 18];
        decoder.decode(scan, (21, 18), &mut out).unwrap();
        assert_eq!(out, decode(&jpeg, 21, 18).unwrap());
        assert!(decoder.start(tables, 22).is_err(), "of another width");
        assert!(decoder.start(&tables[1..], 21).is_err(), "damaged");
        assert!(decoder.decode(scan, (21, 18), &mut out).is_err(), "none are left");
    }
}

/// JPEG tables for one block: numbers of codes by length, and symbols, for DC and AC.
fn tables(dc: (&[u8], &[u8]), ac: (&[u8], &[u8])) -> Vec<u8> {
    let mut all = vec![0xff, 0xd8];
    let mut add = |marker, body: &[u8]| {
        all.extend([0xff, marker]);
        all.extend((body.len() as u16 + 2).to_be_bytes());
        all.extend(body);
    };
    add(0xdb, &[&[1u8][..], &[1; 63], &[99]].concat());
    add(0xc0, &[8, 0, 0, 0, 8, 3, 71, 0x11, 1, 9, 0x11, 1, 200, 0x11, 1]);
    // Both tables in one segment.
    let mut codes = Vec::new();
    for (class, (counts, symbols)) in [(0x01, dc), (0x10, ac)] {
        codes.push(class);
        codes.extend((0..16).map(|len| counts.get(len).copied().unwrap_or(0)));
        codes.extend(symbols);
    }
    add(0xc4, &codes);
    add(0xda, &[3, 71, 0x10, 9, 0x10, 200, 0x10, 0, 63, 0]);
    all
}

/// Decodes bits to 8x8 pixels.
fn decode_bits(tables: &[u8], bits: &str) -> Result<Vec<u8>, String> {
    let mut scan = Vec::new();
    let bits: Vec<char> = bits.chars().filter(|bit| !bit.is_whitespace()).collect();
    for eight in bits.chunks(8) {
        let byte = (0..8).fold(0, |byte, at| byte << 1 | u8::from(eight.get(at) != Some(&'0')));
        scan.push(byte);
        if byte == 0xff {
            scan.push(0);
        }
    }
    scan.extend(END_OF_IMAGE);
    let why = |error| if let DecodeError::Color(why) = error { why } else { panic!("{error}") };
    let mut decoder = JpegSliceDecoder::default();
    decoder.start(tables, 8).map_err(why)?;
    let mut out = vec![0; 192];
    decoder.decode(&scan, (8, 8), &mut out).map_err(why)?;
    Ok(out)
}

#[test]
fn decodes_codes_as_in_the_standard() {
    // DC: 0 is no difference, 10 a difference of 7 bits. AC: 0 is the end, 10 is 16 zeros, 110 is four zeros and a
    // number of 1 bit; a code of 16 bits that begins with 1110 has a number of 10 bits.
    let mut ac_counts = [0u8; 16];
    (ac_counts[0], ac_counts[1], ac_counts[2], ac_counts[15]) = (1, 1, 1, 1);
    let good = tables((&[1, 1], &[0, 7]), (&ac_counts, &[0, 0xf0, 0x41, 0x0a]));
    // Y: DC 64. Cb, Cr: zero.
    let grey = decode_bits(&good, "10 1000000 0  00 00").unwrap();
    assert_eq!(grey, [136; 192]);
    let dark = decode_bits(&good, "10 0111111 0  00 00").unwrap();
    assert_eq!(dark, [120; 192], "negative numbers are complements");
    // Three times sixteen zeros, ten more, and four: the last one is coefficient 63 with nine bits.
    let last = decode_bits(&good, "0 10 10 10 110 1 110 1 110 1 00 00").unwrap();
    assert_ne!(last, [128; 192]);
    let beyond = "a scan has a run beyond its block";
    assert_eq!(decode_bits(&good, "0 10 10 10 10 0 00 00"), Err(beyond.into()));
    assert_eq!(decode_bits(&good, "0 10 10 10 110 1 110 1 10 0 00 00"), Err(beyond.into()));
    let none = "a scan has an invalid code";
    assert_eq!(decode_bits(&good, "11 0 00 00 1111111111111111111111"), Err(none.into()));
    assert_eq!(decode_bits(&good, "0 1111 0000 0000 0000 1111 1111 1111 1111"), Err(none.into()));
    // The longest code and number.
    let long = decode_bits(&good, "0 1110000000000000 1111111111 0  00 00").unwrap();
    assert_eq!([long[0], long[21]], [255, 0]);
    let padded = "a scan has padding other than ones";
    assert_eq!(decode_bits(&good, "000000 00"), Err(padded.into()));
}

#[test]
fn rejects_invalid_tables_with_the_reason() {
    let good = tables((&[1], &[0]), (&[1], &[0]));
    assert!(Tables::read(&good).is_ok());
    let why = |tables: &[u8]| Tables::read(tables).err().unwrap_or("nothing");
    let overfull = "a Huffman table has too many codes";
    assert_eq!(why(&tables((&[3], &[0, 1, 2]), (&[1], &[0]))), overfull);
    assert_eq!(why(&tables((&[1], &[0]), (&[2, 1], &[0, 1, 2]))), overfull);
    let many = [[0u8; 11].as_slice(), &[255]].concat();
    assert!(Tables::read(&tables((&[1], &[0]), (&many, &[1; 255]))).is_ok(), "not full is fine");
    let symbol = "a Huffman table has a symbol that baseline does not allow";
    assert_eq!(why(&tables((&[1], &[12]), (&[1], &[0]))), symbol);
    assert_eq!(why(&tables((&[1], &[0]), (&[1], &[0x0b]))), symbol);
    assert_eq!(why(&tables((&[1], &[0]), (&[1], &[0x10]))), symbol);
    let with = |at: usize, byte: u8| {
        let mut tables = good.clone();
        tables[at] = byte;
        Tables::read(&tables).err().unwrap_or("nothing")
    };
    let frame = 2 + 69;
    assert_eq!(with(6, 0x11), "a quantisation table is not baseline", "16 bits");
    assert_eq!(with(6, 2), "a quantisation table is missing");
    assert_eq!(with(7, 0), "a quantisation table has a step of 0");
    assert_eq!(with(frame + 1, 0xc2), "its JPEG is not baseline, or has two frames");
    assert_eq!(with(frame + 4, 12), "its JPEG does not have 8 bits per sample");
    assert_eq!(with(frame + 9, 1), "its JPEG does not have three components");
    assert_eq!(with(frame + 11, 0x21), "its chroma is neither 4:4:4 nor 4:2:0");
    let scan = good.len() - 12;
    assert_eq!(with(scan + 2 + 1, 5), "its scan and its frame have different components");
    assert_eq!(with(scan + 2 + 2, 0x11), "a Huffman table is missing");
    assert_eq!(with(scan + 2 + 2, 0x20), "a Huffman table is not baseline");
    assert_eq!(with(scan + 2 + 8, 5), "its scan does not have three complete components");
    let with_segment = |segment: &[u8]| [&good[..2], segment, &good[2..]].concat();
    assert_eq!(why(&with_segment(&[0xff, 0xdd, 0, 4, 0, 1])), "its JPEG has restart intervals");
    let adobe = |kind: u8| {
        with_segment(&[&[0xff, 0xee, 0, 14], b"Adobe".as_slice(), &[0; 6], &[kind]].concat())
    };
    assert_eq!(why(&adobe(0)), "its colours are not Y, Cb and Cr");
    assert_eq!(why(&adobe(1)), "nothing");
    assert_eq!(why(&good[..good.len() - 1]), "its tables are cut short");
    assert_eq!(why(&[good.as_slice(), &[0]].concat()), "bytes follow its tables");
}

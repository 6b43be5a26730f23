//! Truncated, damaged or random bytes: an error or an image, never a panic, and no more memory than the caller's
//! buffers.

use proptest::prelude::*;
use vizflyt_rgbd::{
    ColorMode, DecodeError, Decoder, DepthMode, EncodeOptions, HEADER_BYTES, ImageMut,
    SLICE_HEADER_BYTES, peek,
};

mod picture;
use picture::Picture;

const FAST: EncodeOptions = EncodeOptions {
    jpeg_quality: 93,
    color_mode: ColorMode::Jpeg444,
    depth_mode: DepthMode::Fast,
    depth_bound: None,
    slices: 2,
};
const SMALL: EncodeOptions =
    EncodeOptions { color_mode: ColorMode::Lossless, depth_mode: DepthMode::Small, ..FAST };

#[test]
fn rejects_truncation_at_every_length() {
    for options in [FAST, SMALL] {
        let bytes = Picture::new(24, 20).encode(options);
        let mut decoder = Decoder::new();
        for len in 0..bytes.len() {
            let result = Picture::decode(&mut decoder, &bytes[..len]);
            assert!(result.is_err(), "{len} of {} bytes were accepted", bytes.len());
        }
        let mut longer = bytes.clone();
        longer.push(0);
        let result = Picture::decode(&mut decoder, &longer);
        assert!(matches!(result, Err(DecodeError::Length { .. })), "{result:?}");
        assert!(Picture::decode(&mut decoder, &bytes).is_ok(), "a decoder outlives errors");
    }
}

#[test]
fn rejects_a_truncated_part_with_consistent_headers() {
    // The headers match the length, so only the parts' decoders can detect the error.
    for options in [FAST, SMALL] {
        let bytes = Picture::new(24, 18).encode(EncodeOptions { slices: 1, ..options });
        let start = peek(&bytes).unwrap().header_len;
        let parts = start + SLICE_HEADER_BYTES;
        let len_at = |part: usize| start + 4 + 4 * part;
        let lens: Vec<usize> = (0..4)
            .map(|part| u32::from_le_bytes(bytes[len_at(part)..][..4].try_into().unwrap()) as usize)
            .collect();
        for part in 0..4 {
            let end = parts + lens[..=part].iter().sum::<usize>();
            for cut in 1..=lens[part] {
                let mut bytes = bytes.clone();
                bytes.drain(end - cut..end);
                bytes[len_at(part)..][..4]
                    .copy_from_slice(&((lens[part] - cut) as u32).to_le_bytes());
                let result = Picture::decode(&mut Decoder::new(), &bytes);
                assert!(result.is_err(), "part {part} less {cut} bytes was accepted");
            }
        }
    }
}

#[test]
fn jpeg_size_must_match_the_header() {
    let mut bytes = Picture::new(24, 18).encode(FAST);
    bytes[12] = 25;
    let result = Picture::decode(&mut Decoder::new(), &bytes);
    assert!(matches!(result, Err(DecodeError::Color(_))), "{result:?}");
}

#[test]
fn rejects_a_scan_with_a_marker_inside() {
    let picture = Picture::new(24, 16);
    let bytes = picture.encode(FAST);
    let start = peek(&bytes).unwrap().header_len + SLICE_HEADER_BYTES;
    let mut with_marker = bytes.clone();
    with_marker[start + 10..start + 12].copy_from_slice(&[0xff, 0xda]);
    let result = Picture::decode(&mut Decoder::new(), &with_marker);
    assert_eq!(result, Err(DecodeError::Color("a scan has a marker inside".into())));
}

#[test]
fn rejects_unknown_headers_with_the_reason() {
    let bytes = Picture::new(8, 8).encode(FAST);
    let with = |at: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[at] = value;
        peek(&bytes)
    };
    assert!(matches!(with(0, b'X'), Err(DecodeError::Foreign(_))));
    assert_eq!(with(4, 9), Err(DecodeError::Version(9)));
    assert_eq!(with(5, 9), Err(DecodeError::Mode("colour", 9)));
    assert_eq!(with(6, 9), Err(DecodeError::Mode("depth", 9)));
    assert_eq!(with(7, 9), Err(DecodeError::Mode("alpha", 9)));
    assert_eq!(with(8, 9), Err(DecodeError::Mode("ids", 9)));
    assert_eq!(with(9, 2), Err(DecodeError::Slices(2, 1)));
    assert_eq!(with(9, 0), Err(DecodeError::Slices(0, 1)));
    assert!(matches!(with(11, 255), Err(DecodeError::Color(_))));
    assert_eq!(with(13, 255), Err(DecodeError::Size(0xff08, 8)));
    assert_eq!(with(19, 255), Err(DecodeError::Bound(0xff00_0000)));
    assert_eq!(peek(&bytes[..7]), Err(DecodeError::Short(7)));
}

#[test]
fn slice_must_have_its_stated_length() {
    let bytes = Picture::new(8, 8).encode(FAST);
    let info = peek(&bytes).unwrap();
    let (header, slice) = bytes.split_at(info.header_len);
    let mut out = Picture::blank(8, 8);
    let mut decoder = Decoder::new();
    let before = decoder.push_slice(slice, &mut out.room());
    assert_eq!(before, Err(DecodeError::Slice(0)), "no image was started");
    assert_eq!(decoder.start(&bytes[..HEADER_BYTES]), Err(DecodeError::Short(HEADER_BYTES)));
    decoder.start(header).unwrap();
    let short = decoder.push_slice(&slice[..slice.len() - 1], &mut out.room());
    let expected = slice.len() as u64;
    assert_eq!(short, Err(DecodeError::SliceLength { expected, found: slice.len() - 1 }));
    let mut other = slice.to_vec();
    other[0] = 1;
    assert_eq!(decoder.push_slice(&other, &mut out.room()), Err(DecodeError::Slice(1)));
    assert_eq!(decoder.push_slice(slice, &mut out.room()), Ok(0..8));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// Flipped bits give an image or an error, never a panic.
    #[test]
    fn does_not_panic_on_flipped_bits(
        flips in prop::collection::vec((any::<prop::sample::Index>(), 0u8..8), 1..6), small: bool,
    ) {
        let mut bytes = Picture::new(33, 35).encode(if small { SMALL } else { FAST });
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        let mut out = Picture::blank(33, 35);
        let _ = Decoder::new().decode_image(&bytes, &mut out.room());
    }

    /// Random parts after valid headers.
    #[test]
    fn does_not_panic_on_random_parts(
        parts in prop::collection::vec(any::<u8>(), 0..600),
        cuts in prop::array::uniform3(any::<prop::sample::Index>()), small: bool,
    ) {
        let options = EncodeOptions { slices: 1, ..if small { SMALL } else { FAST } };
        let mut bytes = Picture::new(16, 16).encode(options);
        bytes.truncate(peek(&bytes).unwrap().header_len);
        let mut cuts = cuts.map(|cut| cut.index(parts.len() + 1) as u32);
        cuts.sort_unstable();
        let [a, b, c] = cuts;
        let lens = [0, a, b - a, c - b, parts.len() as u32 - c];
        bytes.extend(lens.iter().flat_map(|len| len.to_le_bytes()));
        bytes.extend(&parts);
        let mut out = Picture::blank(16, 16);
        let _ = Decoder::new().decode_image(&bytes, &mut out.room());
        // One part at a time, so that damaged colour does not hide errors of the others.
        let Picture { depth_mm, alpha, ids, .. } = &mut out;
        let _ = Decoder::new().decode(&bytes, &mut [], depth_mm);
        let _ = Decoder::new().decode_image(&bytes, &mut ImageMut { alpha, ..Default::default() });
        let _ = Decoder::new().decode_image(&bytes, &mut ImageMut { ids, ..Default::default() });
    }

    #[test]
    fn does_not_panic_on_arbitrary_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = peek(&bytes);
        let _ = Decoder::new().decode(&bytes, &mut [0; 48], &mut [0; 16]);
    }
}

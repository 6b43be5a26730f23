use super::*;
use proptest::prelude::*;
use std::io::Write as _;

fn picture(width: u32, height: u32, seed: u8) -> Gray {
    let pixels =
        (0..width * height).map(|i| (i as u8).wrapping_mul(7).wrapping_add(seed)).collect();
    Gray::new(width, height, pixels).unwrap()
}

fn pgm(image: &Gray) -> Vec<u8> {
    let mut bytes =
        format!("P5\n# made here\n{} {}\n255\n", image.width_px(), image.height_px()).into_bytes();
    bytes.extend_from_slice(image.pixels());
    bytes
}

fn png(image: &Gray) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let (width, height) = (image.width_px(), image.height_px());
    image::GrayImage::from_raw(width, height, image.pixels().to_vec())
        .unwrap()
        .write_to(&mut bytes, image::ImageFormat::Png)
        .unwrap();
    bytes.into_inner()
}

fn y4m(images: &[Gray], colours: &str, chroma: usize) -> Vec<u8> {
    let (width, height) = (images[0].width_px(), images[0].height_px());
    let mut bytes = format!("YUV4MPEG2 W{width} H{height} F25:1 Ip A1:1 C{colours}\n").into_bytes();
    for (i, image) in images.iter().enumerate() {
        bytes.extend_from_slice(format!("FRAME XSTAMP_NS={}\n", 1000 + i).as_bytes());
        bytes.extend_from_slice(image.pixels());
        bytes.extend(std::iter::repeat_n(128u8, chroma));
    }
    bytes
}

fn all(source: &mut dyn ImageSource) -> Vec<Exposure> {
    std::iter::from_fn(|| source.next().unwrap()).collect()
}

#[test]
fn decodes_every_file_format() {
    let image = picture(13, 7, 1);
    assert_eq!(decode(&png(&image)).unwrap(), image);
    assert_eq!(decode(&pgm(&image)).unwrap(), image);
    for bytes in
        [&png(&image)[..40], &pgm(&image)[..40], b"P5 9999999 1 255\n", b"\xff\xd8\xff", b""]
    {
        assert!(decode(bytes).is_err());
    }
}

#[test]
fn reads_a_folder_in_numeric_order_with_its_stamps() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    for i in [10u8, 9, 1] {
        write(&format!("{i}.png"), &png(&picture(4, 3, i)));
    }
    write("notes.txt", b"no image");
    let open = || open(folder.path().to_str().unwrap());
    let images = all(open().unwrap().as_mut());
    assert_eq!(images.iter().map(|e| e.image.at(0, 0)).collect::<Vec<_>>(), [1, 9, 10]);
    assert_eq!(images[2].stamp_ns, 2 * Folder::PERIOD_NS);
    write("stamps.csv", b"name, stamp_ns\n1.png, 50\n9.png,70\n10.png,90\n");
    let images = all(open().unwrap().as_mut());
    assert_eq!(images.iter().map(|e| e.stamp_ns).collect::<Vec<_>>(), [50, 70, 90]);
    let refused = |parts: &[&str]| {
        let error = match open() {
            Err(error) => error.to_string(),
            Ok(_) => panic!("opened"),
        };
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    };
    write("stamps.csv", b"1.png,50\n9.png,70\n");
    refused(&["stamps.csv", "no line for 10.png"]);
    write("stamps.csv", b"1.png,50\n9.png;70\n");
    refused(&["stamps.csv", "line 2"]);
    std::fs::remove_file(folder.path().join("stamps.csv")).unwrap();
    write("10.png", b"\x89PNG damaged");
    let mut source = open().unwrap();
    let error = loop {
        match source.next() {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the damaged file was skipped"),
            Err(error) => break error.to_string(),
        }
    };
    assert!(error.contains("10.png"), "{error}");
}

#[test]
fn reads_stamps_from_file_names() {
    let folder = tempfile::tempdir().unwrap();
    let name = folder.path().join("1700000000000000123.pgm");
    std::fs::write(name, pgm(&picture(2, 2, 0))).unwrap();
    let images = all(open(folder.path().to_str().unwrap()).unwrap().as_mut());
    assert_eq!(images[0].stamp_ns, 1_700_000_000_000_000_123);
}

#[test]
fn rejects_invalid_sources_by_name() {
    let refused = |source: &str, part: &str| {
        let error = match open(source) {
            Err(error) => error.to_string(),
            Ok(mut source) => source.next().unwrap_err().to_string(),
        };
        assert!(error.contains(part), "{error:?} lacks {part:?}");
    };
    refused("/nowhere/at/all", "/nowhere/at/all");
    let empty = tempfile::tempdir().unwrap();
    refused(empty.path().to_str().unwrap(), "no .png, .jpg or .pgm");
    #[cfg(target_os = "linux")]
    refused("/dev/null", "/dev/null");
    refused("| printf 'hello, this is no stream of images\\n'", "not a YUV4MPEG2 stream");
    refused("| exit 3", "exit status: 3");
    refused("| true", "no image");
}

#[test]
fn reads_images_of_a_command_until_it_ends() {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    let images = [picture(4, 3, 1), picture(4, 3, 2)];
    file.write_all(&y4m(&images, "mono", 0)).unwrap();
    let mut source = open(&format!("| cat '{}'", file.path().display())).unwrap();
    assert!(source.is_live());
    let found = all(source.as_mut());
    assert_eq!(found.iter().map(|e| e.stamp_ns).collect::<Vec<_>>(), [1000, 1001]);
    assert!(found.iter().zip(&images).all(|(e, image)| e.image == *image));
}

proptest! {
    #[test]
    fn parses_a_stream_in_chunks_of_any_size(chunk in 1usize..200, odd: bool) {
        let (width, height) = if odd { (5, 3) } else { (6, 4) };
        let images: Vec<Gray> = (0..3).map(|i| picture(width, height, i)).collect();
        let chroma = 2 * (width.div_ceil(2) * height.div_ceil(2)) as usize;
        let bytes = y4m(&images, "420jpeg", chroma);
        let mut stream = Y4m::default();
        let mut found = Vec::new();
        for chunk in bytes.chunks(chunk) {
            stream.push(chunk);
            while let Some((stamp_ns, image)) = stream.poll().unwrap() {
                prop_assert_eq!(stamp_ns, Some(1000 + found.len() as u64));
                found.push(image);
            }
        }
        prop_assert_eq!(found, images);
        prop_assert_eq!(stream.rate_hz(), Some(25.0));
    }

    #[test]
    fn pgm_survives_a_round_trip(width in 1u32..40, height in 1u32..40, seed: u8) {
        let image = picture(width, height, seed);
        prop_assert_eq!(decode(&pgm(&image)).unwrap(), image);
    }

    #[test]
    fn does_not_panic_on_arbitrary_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = decode(&bytes);
        let mut stream = Y4m::default();
        stream.push(&bytes);
        let _ = stream.poll();
        let _ = parse_stamps(&String::from_utf8_lossy(&bytes));
    }
}

#[test]
fn reads_a_video_with_ffmpeg() {
    // `tests/run` installs ffmpeg.
    let folder = tempfile::tempdir().unwrap();
    let images: Vec<Gray> = (0..5).map(|i| Gray::plain(32, 16, 40 * i + 20)).collect();
    std::fs::write(folder.path().join("plain.y4m"), y4m(&images, "420jpeg", 2 * 16 * 8)).unwrap();
    let video = folder.path().join("video.mkv");
    let status = std::process::Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(folder.path().join("plain.y4m"))
        .args(["-c:v", "ffv1"])
        .arg(&video)
        .status()
        .expect("ffmpeg is installed");
    assert!(status.success());
    let mut source = open(video.to_str().unwrap()).unwrap();
    assert!(!source.is_live());
    let found = all(source.as_mut());
    assert_eq!(
        found.iter().map(|e| e.stamp_ns).collect::<Vec<_>>(),
        [0, 40, 80, 120, 160].map(|ms| ms * 1_000_000)
    );
    for (i, exposure) in found.iter().enumerate() {
        assert_eq!((exposure.image.width_px(), exposure.image.height_px()), (32, 16));
        // Video omits the darkest and brightest levels; grey uses the full range.
        let expected = ((40.0 * i as f64 + 20.0 - 16.0) / 219.0 * 255.0).clamp(0.0, 255.0);
        let grey = f64::from(exposure.image.at(5, 5));
        assert!(
            (grey - expected).abs() < 3.0 || (grey - 40.0 * i as f64 - 20.0).abs() < 3.0,
            "{grey}"
        );
    }
    let damaged = folder.path().join("damaged.mkv");
    std::fs::write(&damaged, b"no video").unwrap();
    let mut source = open(damaged.to_str().unwrap()).unwrap();
    let error = source.next().unwrap_err().to_string();
    assert!(error.contains("damaged.mkv") && error.contains("ended"), "{error}");
}

#[test]
fn returns_colours_as_three_full_planes_only() {
    let mut stream = Y4m::default();
    stream.push(b"YUV4MPEG2 W2 H1 F30:1 C444\nFRAME\n\x01\x02\x03\x04\x05");
    assert_eq!(stream.poll_colours(), Ok(None), "a byte is missing");
    stream.push(b"\x06");
    let image = stream.poll_colours().unwrap().unwrap();
    assert_eq!((image.width_px, image.height_px, image.luma()), (2, 1, &[1, 2][..]));
    assert_eq!(image.planes, [1, 2, 3, 4, 5, 6]);
    let mut coarse = Y4m::default();
    coarse.push(b"YUV4MPEG2 W2 H1 F30:1 C420jpeg\nFRAME\n\x01\x02\x03\x04");
    assert!(coarse.poll_colours().unwrap_err().contains("yuv444p"));
}

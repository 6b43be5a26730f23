//! Reads folders as datasets, and trains twins: photos of a small synthetic wall, written in the formats of COLMAP and
//! nerfstudio.

use std::fmt::Write as _;
use std::path::Path;

use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};
use vizflyt_splat::gpu::{Adapter, Budget};
use vizflyt_splat::{Camera, Splats, render_reference};
use vizflyt_twin::random::Random;
use vizflyt_twin::train::{Checkpoint, CheckpointError};
use vizflyt_twin::{Dataset, Options, Passes, Trainer};

const PHOTOS: usize = 6;

fn intrinsics() -> Intrinsics {
    Intrinsics::from_horizontal_fov(48, 36, 1.2)
}

/// Returns poses along a line, looking at a wall 3 units ahead.
fn pose(i: usize) -> Pose<World, Cam> {
    let x = 0.3 * (i as f64 - 2.5);
    Pose::new(DVec3::new(x, 0.1 * (i % 2) as f64, 0.0), DQuat::from_rotation_y(-0.1 * x))
}

/// Returns a wall of coloured discs.
fn wall() -> Splats {
    let mut random = Random::new(2);
    let mut splats = Splats::default();
    for n in 0..400 {
        let (x, y) = ((n % 20) as f32 * 0.3 - 2.85, (n / 20) as f32 * 0.25 - 2.4);
        splats.means_m.push(Vec3::new(x, y, 3.0));
        splats.scales_m.push(Vec3::new(0.2, 0.2, 0.01));
        splats.rotations.push(Quat::IDENTITY);
        splats.opacities.push(0.95);
        let side = f32::from((n / 3 + n / 60) % 2 == 0);
        splats.sh.extend([side, 0.5 - side, 0.3 * random.unit()]);
    }
    splats
}

fn photograph(folder: &Path) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let wall = wall();
    for i in 0..PHOTOS {
        let image =
            render_reference(&wall, &[], &Camera::new(intrinsics(), pose(i), 0.05)).unwrap();
        let mut rgb = Vec::new();
        image.write_rgb8(&mut rgb);
        let path = folder.join(format!("images/{i}.png"));
        image::save_buffer(path, &rgb, 48, 36, image::ExtendedColorType::Rgb8).unwrap();
        let mm: Vec<u8> =
            image.depth_median_m.iter().flat_map(|d| ((d * 1e3) as u16).to_ne_bytes()).collect();
        let path = folder.join(format!("images/{i}_depth.png"));
        image::save_buffer(path, &mm, 48, 36, image::ExtendedColorType::L16).unwrap();
    }
}

fn colmap(folder: &Path) {
    photograph(folder);
    let sparse = folder.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    let k = intrinsics();
    let camera = format!("1 SIMPLE_PINHOLE 48 36 {} 24 18\n", k.fx_px);
    std::fs::write(sparse.join("cameras.txt"), camera).unwrap();
    let wall = wall();
    let (mut images, mut points) = (String::new(), String::new());
    for (i, p) in wall.means_m.iter().enumerate().step_by(7) {
        writeln!(points, "{} {} {} {} 120 120 120 0.5 1 0 2 0 3 0", i + 1, p.x, p.y, p.z).unwrap();
    }
    for i in 0..PHOTOS {
        let Pose { translation_m: t, rotation: q, .. } = pose(i).inverse();
        writeln!(
            images,
            "{} {} {} {} {} {} {} {} 1 {i}.png",
            i + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z
        )
        .unwrap();
        for (n, p) in wall.means_m.iter().enumerate().step_by(7) {
            let p_cam = pose(i).inverse().transform_point(p.as_dvec3());
            if let Some(at) = k.project(p_cam) {
                write!(images, "{} {} {} ", at.x, at.y, n + 1).unwrap();
            }
        }
        images.push('\n');
    }
    std::fs::write(sparse.join("images.txt"), images).unwrap();
    std::fs::write(sparse.join("points3D.txt"), points).unwrap();
}

fn nerfstudio(folder: &Path) {
    photograph(folder);
    let k = intrinsics();
    let frames: Vec<String> = (0..PHOTOS)
        .map(|i| {
            let Pose { translation_m: t, rotation, .. } = pose(i);
            // OpenGL's camera: y up, z backward.
            let [x, y, z] = [rotation * DVec3::X, rotation * -DVec3::Y, rotation * -DVec3::Z];
            let row = |k: usize| format!("[{}, {}, {}, {}]", x[k], y[k], z[k], t[k]);
            format!(
                "{{\"file_path\": \"images/{i}.png\", \"depth_file_path\": \"images/{i}_depth.png\", \
                 \"transform_matrix\": [{}, {}, {}, [0, 0, 0, 1]]}}",
                row(0), row(1), row(2)
            )
        })
        .collect();
    let text = format!(
        "{{\"camera_model\": \"PINHOLE\", \"fl_x\": {}, \"w\": 48, \"h\": 36, \"frames\": [{}]}}",
        k.fx_px,
        frames.join(", ")
    );
    std::fs::write(folder.join("transforms.json"), text).unwrap();
}

fn options() -> Options {
    Options { steps: 150, splats: 1500, degree: 0, hold_out: 3, ..Options::default() }
}

fn train(dataset: &Dataset) -> (f64, Splats) {
    let mut trainer = Trainer::new(dataset, options());
    while trainer.steps() < options().steps {
        trainer.step();
    }
    (trainer.judge().unwrap().psnr_db, trainer.splats())
}

#[test]
fn rebuilds_a_wall_from_both_dataset_formats() {
    for write in [colmap as fn(&Path), nerfstudio] {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path());
        let dataset = Dataset::read(folder.path(), None).unwrap();
        assert_eq!(dataset.photos.len(), PHOTOS);
        let before = Trainer::new(&dataset, options()).judge().unwrap().psnr_db;
        let (after, splats) = train(&dataset);
        assert!(after > before + 0.5 && after > 22.0, "{before:.1} dB, then {after:.1}");
        // Check the depth, not only the appearance.
        let image =
            render_reference(&splats, &[], &Camera::new(intrinsics(), pose(3), 0.05)).unwrap();
        let mut errors: Vec<f32> =
            image.depth_median_m.iter().map(|d| (d / 3.0 - 1.0).abs()).collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 0.05, "{}", errors[errors.len() / 2]);
    }
}

#[test]
fn same_seed_gives_the_same_twin_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    colmap(folder.path());
    let dataset = Dataset::read(folder.path(), None).unwrap();
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| train(&dataset))
    };
    let one = on(1);
    assert!(one == on(4), "four threads train a different twin");
}

/// Trains, and loses the device after a number of steps. Returns the loss of each step, and the PSNR of held-out
/// photos.
fn train_on(dataset: &Dataset, passes: Passes, lost_after: u32) -> (Vec<f64>, f64) {
    let mut trainer = Trainer::with(dataset, options(), passes);
    let mut losses = Vec::new();
    while trainer.steps() < options().steps {
        losses.push(trainer.step().total(&options().weights));
        if trainer.steps() == lost_after {
            trainer.passes().lose_device();
        }
    }
    (losses, trainer.judge().unwrap().psnr_db)
}

#[test]
fn graphics_card_trains_like_the_processor() {
    let Some(adapter) = Adapter::all().into_iter().next() else {
        println!("skipped: no graphics adapter; install mesa-vulkan-drivers and libvulkan1");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    colmap(folder.path());
    let dataset = Dataset::read(folder.path(), None).unwrap();
    let passes = || Passes::gpu(&adapter, Budget::default()).expect("a device");
    let (expected, expected_db) = train_on(&dataset, Passes::cpu(), u32::MAX);
    let first = train_on(&dataset, passes(), u32::MAX);
    let lost = train_on(&dataset, passes(), 70);
    assert!(first.0[..70] == lost.0[..70], "the same device trains a different twin");
    // Rounding differences grow with the steps, but the course of the training stays the same.
    for (what, (losses, db)) in [("gpu", first), ("gpu, lost after 70 steps", lost)] {
        println!("{what}: {db:.2} dB for {expected_db:.2}");
        assert!((db - expected_db).abs() < 0.5, "{what}: {db} dB for {expected_db}");
        for (i, (a, b)) in losses.chunks(30).zip(expected.chunks(30)).enumerate() {
            let ratio = a.iter().sum::<f64>() / b.iter().sum::<f64>();
            assert!((ratio - 1.0).abs() < 0.03, "{what}, steps from {}: {ratio}", 30 * i);
        }
    }
}

#[test]
fn resumed_training_equals_an_uninterrupted_one() {
    let folder = tempfile::tempdir().unwrap();
    colmap(folder.path());
    let dataset = Dataset::read(folder.path(), None).unwrap();
    let whole = train(&dataset);
    let mut trainer = Trainer::new(&dataset, options());
    // Stop in the middle of a pass over the photos, at a relocation, and around it; each time through bytes.
    for stop in [7, 50, 51, 99, 150] {
        while trainer.steps() < stop {
            trainer.step();
        }
        let bytes = trainer.checkpoint().to_bytes();
        let checkpoint = Checkpoint::from_bytes(&bytes).unwrap();
        assert_eq!(checkpoint.steps(), stop);
        trainer = Trainer::resume(&dataset, options(), Passes::cpu(), checkpoint).unwrap();
        assert!(trainer.checkpoint().to_bytes() == bytes);
    }
    assert!((trainer.judge().unwrap().psnr_db, trainer.splats()) == whole);

    let checkpoint = trainer.checkpoint();
    let other = Options { seed: 2, ..options() };
    let refused = Trainer::resume(&dataset, other, Passes::cpu(), checkpoint.clone());
    assert_eq!(refused.err(), Some(CheckpointError::Training));
    let small = Dataset::read(folder.path(), Some(24)).unwrap();
    let refused = Trainer::resume(&small, options(), Passes::cpu(), checkpoint);
    assert_eq!(refused.err(), Some(CheckpointError::Training));
}

#[test]
fn reduces_photos_and_keeps_poses() {
    let folder = tempfile::tempdir().unwrap();
    colmap(folder.path());
    let whole = Dataset::read(folder.path(), None).unwrap();
    let half = Dataset::read(folder.path(), Some(24)).unwrap();
    let (a, b) = (&whole.photos[2].view, &half.photos[2].view);
    assert_eq!((b.width, b.height, a.position), (24, 18, b.position));
    let p = Vec3::new(0.2, -0.4, 3.0);
    let (([u, v], _), ([x, y], _)) = (a.project(p).unwrap(), b.project(p).unwrap());
    assert!((u / 2.0 - x).abs() < 1e-4 && (v / 2.0 - y).abs() < 1e-4);
    assert!(!whole.photos[2].target.points.is_empty());
}

#[test]
fn omits_and_names_missing_photos() {
    let folder = tempfile::tempdir().unwrap();
    colmap(folder.path());
    let remove = |i: usize| {
        std::fs::remove_file(folder.path().join(format!("images/{i}.png"))).unwrap();
    };
    remove(3);
    let dataset = Dataset::read(folder.path(), None).unwrap();
    assert_eq!((dataset.photos.len(), dataset.absent), (PHOTOS - 1, vec!["3.png".to_owned()]));
    (0..3).for_each(remove);
    let error = Dataset::read(folder.path(), None).unwrap_err().to_string();
    assert!(error.starts_with("4 of the 6 photos") && error.contains("0.png"), "{error}");
}

#[test]
fn error_names_the_fault_of_a_damaged_folder() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |says: &str| {
        let error = Dataset::read(folder.path(), None).unwrap_err().to_string();
        assert!(error.contains(says), "{error}");
    };
    refused("transforms.json");
    colmap(folder.path());
    let image = folder.path().join("images/3.png");
    let bytes = std::fs::read(&image).unwrap();
    std::fs::write(&image, &bytes[..bytes.len() / 2]).unwrap();
    refused("3.png");
    std::fs::write(&image, "<html>not found</html>").unwrap();
    refused("neither PNG nor JPEG");
    image::save_buffer(&image, &[0; 300], 10, 10, image::ExtendedColorType::Rgb8).unwrap();
    refused("another shape");
    let sparse = folder.path().join("sparse/0");
    std::fs::write(sparse.join("cameras.txt"), "1 FOV 48 36 30 30 24 18 0.9\n").unwrap();
    refused("colmap image_undistorter");
    std::fs::write(sparse.join("images.txt"), "").unwrap();
    std::fs::write(sparse.join("cameras.txt"), "").unwrap();
    refused("at least 2");
}

//! Accuracy of the localization by tags against known truth. Images are rendered with distortion, blur of optics and
//! motion, noise, and uneven light; in front of a plain wall, and in the hall as the splat renderer renders it.

mod flights;
mod hall;

use flights::{
    Figures, Path, fly, fly_over_mat, lemniscate, locate, pads, pose_on, spiral, square,
};
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_tags::simulated::{Sensor, SimulatedCamera, cube, webcams};

fn print_figures(name: &str, figures: &Figures) {
    println!(
        "{name}: {:.1} mm rms, {:.1} mm p99, {:.2} deg rms, located in {:.1} % of {}; squared errors {:.2} times the \
         predicted; searched {:.1} % of the images; {:?}",
        figures.rms_mm(),
        figures.p99_mm(),
        figures.rms_deg(),
        figures.availability_percent(),
        figures.sets,
        figures.consistency(),
        100.0 * figures.looked_at / figures.sets as f64,
        figures.unlocated
    );
}

#[test]
fn two_webcams_locate_the_cube_along_square_spiral_and_lemniscate() {
    let (mut squared, mut looked_at, mut sets) = (0.0, 0.0, 0);
    for (name, path, speed_mps) in
        [("square", square as Path, 1.5), ("spiral", spiral, 1.5), ("lemniscate", lemniscate, 2.0)]
    {
        let figures = fly(webcams(2), &[cube()], Sensor::default(), false, 5.0, |t_s| {
            pose_on(path, speed_mps, t_s)
        });
        print_figures(name, &figures);
        assert!(figures.rms_mm() <= 15.0 && figures.p99_mm() <= 50.0, "{name}");
        assert!(figures.rms_deg() <= 1.0, "{name}");
        assert!(figures.availability_percent() >= 99.0, "{name}");
        squared += figures.squared_sigmas / (6 * figures.errors_m.len()) as f64 / 3.0;
        looked_at += figures.looked_at;
        sets += figures.sets;
    }
    // Errors are not larger than predicted.
    assert!((0.05..1.5).contains(&squared), "{squared}");
    // After the first image, complete images are not searched.
    assert!(looked_at < 0.05 * sets as f64, "{looked_at} of {sets}");
}

/// The lab's room with pictures, windows and edges, rendered through the cameras' own lenses.
#[test]
fn locates_in_front_of_a_rendered_hall() {
    let figures =
        locate(hall::seen_by(webcams(2)), &[cube()], 4.0, |t_s| pose_on(lemniscate, 2.0, t_s));
    print_figures("in the hall", &figures);
    assert!(figures.rms_mm() <= 15.0 && figures.p99_mm() <= 50.0);
    assert!(figures.rms_deg() <= 1.0);
    assert!(figures.availability_percent() >= 99.0);

    let figures =
        fly_over_mat(Vec::new(), 7, hall::before(), 1.5, |t_s| pose_on(at_a_metre, 1.0, t_s));
    print_figures("over the mat in the hall", &figures);
    assert!(figures.rms_mm() <= 8.0, "{} mm", figures.rms_mm());
    assert!(figures.rms_deg() <= 1.0);
    assert!(figures.availability_percent() >= 99.0);
}

/// Returns the lemniscate, 1 m above the floor.
fn at_a_metre(s_m: f64) -> DVec3 {
    lemniscate(s_m) * DVec3::new(1.0, 1.0, 0.0) + DVec3::Z
}

/// Returns a flight from one pad, up, along the hall and down onto another pad: every height occurs, and sigma must
/// match. [m, world] by [s]
fn from_pad_to_pad(t_s: f64) -> Pose<World, Body> {
    // Smooth step from 0 to 1 within a time interval.
    let smooth = |from_s: f64, to_s: f64| {
        let t = ((t_s - from_s) / (to_s - from_s)).clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    };
    let (up, across, down) = (smooth(0.5, 2.0), smooth(2.0, 6.0), smooth(6.0, 8.0));
    let aside_m = 0.4 * (across * std::f64::consts::TAU).sin();
    let at = DVec3::new(0.9 + 8.75 * across, aside_m, 1.2 * (up - down));
    Pose::new(at, DQuat::from_rotation_z(0.5 * across))
}

#[test]
fn webcam_under_the_vehicle_locates_it_over_a_mat() {
    for seed in [1, 2, 3] {
        let figures = fly_over_mat(pads(), seed, SimulatedCamera::new, 8.5, from_pad_to_pad);
        print_figures(&format!("from pad to pad, seed {seed}"), &figures);
        assert!(figures.rms_mm() <= 6.0 && figures.p99_mm() <= 15.0, "seed {seed}");
        assert!(figures.rms_deg() <= 1.0, "seed {seed}");
        assert!(figures.availability_percent() >= 99.0, "seed {seed}: {:?}", figures.unlocated);
        let honest = figures.position_consistency();
        println!("squared errors of the position {honest:.2} times the predicted");
        // The lower limit allows for cautious sigmas: constant errors do not average out in the filter
        // (tests/e2e/tests/flights/mat.rs).
        assert!((0.3..2.0).contains(&honest), "seed {seed}: {honest}");
    }
}

//! Is the vehicle located as well as the lab needs, against known truth? Images are rendered with distortion,
//! blur of optics and motion, noise, uneven light; before a plain wall, and in the hall as the splat renderer
//! renders it.

mod flights;
mod hall;

use flights::{Figures, Path, fly, lemniscate, locate, pose_on, spiral, square};
use glam::{DVec2, DVec3};
use vizflyt_tags::simulated::{Sensor, belly_camera, cube, mat, webcams};

fn print_figures(name: &str, figures: &Figures) {
    println!(
        "{name}: {:.1} mm rms, {:.1} mm p99, {:.2} deg rms, located in {:.1} % of {}; squared errors {:.2} of the \
         predicted; looked at {:.1} % of the images; {:?}",
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
    // Errors are as large as predicted, or smaller.
    assert!((0.05..1.5).contains(&squared), "{squared}");
    // After the first, images are not searched as a whole.
    assert!(looked_at < 0.05 * sets as f64, "{looked_at} of {sets}");
}

/// The room of the lab full of pictures, windows, edges, rendered through the cameras' own lenses.
#[test]
fn the_hall_behind_the_tags_changes_nothing() {
    let figures =
        locate(hall::seen_by(webcams(2)), &[cube()], 4.0, |t_s| pose_on(lemniscate, 2.0, t_s));
    print_figures("in the hall", &figures);
    assert!(figures.rms_mm() <= 15.0 && figures.p99_mm() <= 50.0);
    assert!(figures.rms_deg() <= 1.0);
    assert!(figures.availability_percent() >= 99.0);

    let mat = mat(DVec2::new(2.5, -1.8), DVec2::new(8.5, 1.8));
    let over = |s_m: f64| lemniscate(s_m) * DVec3::new(1.0, 1.0, 0.0) + DVec3::Z;
    let figures =
        locate(hall::seen_by(vec![belly_camera()]), &[mat], 1.5, |t_s| pose_on(over, 1.0, t_s));
    print_figures("over the mat in the hall", &figures);
    assert!(figures.rms_mm() <= 8.0, "{} mm", figures.rms_mm());
    assert!(figures.rms_deg() <= 1.0);
    assert!(figures.availability_percent() >= 99.0);
}

#[test]
fn a_webcam_under_the_vehicle_locates_it_over_a_mat() {
    let mat = mat(DVec2::new(2.5, -1.8), DVec2::new(8.5, 1.8));
    let over = |s_m: f64| lemniscate(s_m) * DVec3::new(1.0, 1.0, 0.0) + DVec3::Z;
    let figures = fly(vec![belly_camera()], &[mat], Sensor::default(), false, 4.0, |t_s| {
        pose_on(over, 1.0, t_s)
    });
    print_figures("over the mat", &figures);
    assert!(figures.rms_mm() <= 8.0, "{} mm", figures.rms_mm());
    assert!(figures.rms_deg() <= 1.0);
    assert!(figures.availability_percent() >= 99.0);
}

use std::sync::LazyLock;

use glam::{DQuat, DVec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use super::*;
use crate::bundle::Rigid;
use crate::synth::Random;

pub(crate) const BOARD: Checkerboard = Checkerboard { columns: 9, rows: 6, square_m: 0.025 };

pub(crate) fn webcam() -> Intrinsics {
    let distortion =
        Distortion::BrownConrady { k1: -0.16, k2: 0.06, p1: 0.0008, p2: -0.0011, k3: 0.0 };
    Intrinsics {
        fx_px: 460.0,
        fy_px: 459.0,
        cx_px: 323.0,
        cy_px: 236.0,
        distortion,
        ..Intrinsics::from_horizontal_fov(640, 480, 1.2)
    }
}

/// Renderer of the test webcam, shared by all tests.
pub(crate) static PAINTER: LazyLock<Painter> = LazyLock::new(|| Painter::new(webcam()));

/// Renders the board with nine rays per pixel.
pub(crate) struct Painter {
    lens: Intrinsics,
    slopes: Vec<DVec2>,
}

impl Painter {
    fn new(lens: Intrinsics) -> Self {
        let places = (0..lens.height_px).flat_map(|y| (0..lens.width_px).map(move |x| (x, y)));
        let slopes = places
            .flat_map(|(x, y)| {
                (0..RAYS).map(move |i| {
                    let part = (DVec2::new((i % 3) as f64, (i / 3) as f64) - 1.0) / 3.0;
                    // The optics spread a pixel's footprint.
                    DVec2::new(x.into(), y.into()) + 0.5 + part * 1.6
                })
            })
            .map(|px| lens.slope(px).expect("within the lens"))
            .collect();
        Self { lens, slopes }
    }

    pub(crate) fn paint(&self, board: &Checkerboard, at: &Rigid, noise: f64, seed: u64) -> Gray {
        let mut random = Random::new(seed);
        let back = at.q.conjugate();
        let (origin, normal) = (back * -at.t_m, at.q * DVec3::Z);
        let half = DVec2::new(f64::from(board.columns + 1), f64::from(board.rows + 1)) / 2.0;
        let pixels = self.slopes.chunks(RAYS).enumerate().map(|(index, rays)| {
            let sum: f64 = rays
                .iter()
                .map(|slope| {
                    let ray = slope.extend(1.0);
                    let depth = at.t_m.dot(normal) / ray.dot(normal);
                    let p = (origin + back * ray * depth).truncate() / board.square_m + half;
                    let inside = p.cmpge(DVec2::ZERO).all() && p.cmplt(2.0 * half).all();
                    let cell = p.floor();
                    let rim = p.cmpge(DVec2::splat(-1.0)).all() && p.cmplt(2.0 * half + 1.0).all();
                    match (depth > 0.0 && rim, inside && (cell.x + cell.y).rem_euclid(2.0) < 0.5) {
                        (false, _) => 90.0,
                        (true, true) => 35.0,
                        (true, false) => 200.0,
                    }
                })
                .sum();
            // Brightness increases to the right.
            let light = 0.85
                + 0.3 * (index % self.lens.width_px as usize) as f64
                    / f64::from(self.lens.width_px);
            (sum / RAYS as f64 * light + noise * random.normal()).clamp(0.0, 255.0) as u8
        });
        Gray::new(self.lens.width_px, self.lens.height_px, pixels.collect()).unwrap()
    }
}

const RAYS: usize = 9;
/// Maximum offset at which the whole board stays in the image at any tilt.
const WHOLE_PX: DVec2 = DVec2::new(105.0, 88.0);

/// Pose of a tilted board in front of the camera, in one of nine parts of the image, up to `reach_px` from its middle.
pub(crate) fn pose(i: u32, tilt_rad: f64, reach_px: DVec2, random: &mut Random) -> Rigid {
    let lens = webcam();
    let place = DVec2::new(f64::from(i % 3) - 1.0, f64::from(i / 3 % 3) - 1.0);
    let depth_m = 0.42 + 0.1 * random.unit();
    let slope = place * reach_px / lens.fx_px;
    let tilt = DVec3::new(random.unit() - 0.5, random.unit() - 0.5, 0.3 * (random.unit() - 0.5));
    let facing = DQuat::from_rotation_x(std::f64::consts::PI);
    Rigid {
        t_m: (slope * depth_m).extend(depth_m),
        q: DQuat::from_scaled_axis(tilt * 2.0 * tilt_rad) * facing,
    }
}

#[test]
fn finds_all_corners_at_their_positions() {
    let (lens, painter) = (webcam(), &*PAINTER);
    let mut random = Random::new(5);
    let (mut found, mut square_sum, mut count) = (0, 0.0, 0);
    for i in 0..18 {
        let at = pose(i, 0.7, WHOLE_PX, &mut random);
        let expected: Option<Vec<DVec2>> =
            BOARD.corners_m().iter().map(|p| lens.project(at.apply(p.extend(0.0)))).collect();
        let expected = expected.unwrap();
        let Some(corners) = BOARD.find(&painter.paint(&BOARD, &at, 2.0, i.into())) else {
            continue;
        };
        found += 1;
        for (corner, truth) in corners.iter().zip(&expected) {
            let off_px = corner.distance(*truth);
            assert!(off_px < 0.6, "{off_px} px off in view {i}");
            square_sum += off_px * off_px;
            count += 1;
        }
    }
    let rms_px = (square_sum / f64::from(count)).sqrt();
    println!("{found} of 18 boards, corners {rms_px:.3} px off");
    assert!(found >= 15 && rms_px < 0.15, "{found} of 18 boards, corners {rms_px} px off");
}

#[test]
fn rejects_a_partly_visible_or_different_board() {
    let painter = &*PAINTER;
    let mut random = Random::new(2);
    let at = pose(4, 0.2, WHOLE_PX, &mut random);
    let whole = painter.paint(&BOARD, &at, 2.0, 1);
    assert!(BOARD.find(&whole).is_some());
    assert!(Checkerboard { columns: 8, ..BOARD }.find(&whole).is_none());
    // The same board, rotated by 90 degrees.
    assert!(Checkerboard { columns: 6, rows: 9, ..BOARD }.find(&whole).is_some());
    let beside = Rigid { t_m: at.t_m + DVec3::X * 0.25, ..at };
    assert!(BOARD.find(&painter.paint(&BOARD, &beside, 2.0, 1)).is_none());
    for image in [Gray::plain(640, 480, 90), Gray::plain(3, 3, 0), Gray::default()] {
        assert!(BOARD.find(&image).is_none());
    }
}

#[test]
fn file_survives_a_round_trip_and_invalid_values_are_rejected() {
    assert_eq!(Checkerboard::parse(&BOARD.to_toml().unwrap()).unwrap(), BOARD);
    let check = |text: &str, part: &str| {
        let error = Checkerboard::parse(text).unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} lacks {part:?}");
    };
    check("[checkerboard]\ncolumns = 2\nrows = 6\nsquare_m = 0.02", "checkerboard.columns = 2");
    check("[checkerboard]\ncolumns = 9\nrows = 6\nsquare_m = nan", "checkerboard.square_m");
    check("[checkerboard]\ncolumns = 9\nrows = 6", "square_m");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]
    /// For any image, the result is a complete board or none.
    #[test]
    fn finds_a_complete_board_or_none_in_noise(seed in 0u64..1000, least in 0u32..3) {
        let mut random = Random::new(seed);
        let pixels = (0..80 * 60).map(|_| (255.0 * random.unit()) as u8).collect();
        let image = Gray::new(80, 60, pixels).unwrap();
        let board = Checkerboard { columns: 3 + least, rows: 3, square_m: 0.02 };
        if let Some(corners) = board.find(&image) {
            prop_assert!(corners.len() == board.count() && corners.iter().all(|c| c.is_finite()));
        }
    }
}

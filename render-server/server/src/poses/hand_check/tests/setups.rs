//! Lab set-ups, streamed by a generator that is independent of the settings' code: plain matrices, own
//! quaternions, JSON text. The driver reads them, and the check judges them.

use std::fmt::Write;

use crate::poses::drivers::json::JsonStream;
use crate::poses::drivers::udp::PoseStream;
use vizflyt_protocol::time::ServerTime;

use super::super::*;

type Matrix = [[f64; 3]; 3];

/// x east, y north, z up; or x forward, y left, z up.
const SAME_AXES: Matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
/// Motive's room axes from ours: x, z, -y.
const Y_UP: Matrix = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]];
/// North, east, down.
const NED: Matrix = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]];
/// Forward, right, down.
const FRD: Matrix = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];
/// Left-handed: y the other way.
const MIRROR: Matrix = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]];
/// Unity: x right, y up, z forward of a body; the same for the room.
const UNITY: Matrix = [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]];

/// Order of a quaternion's numbers.
#[derive(Clone, Copy, Debug)]
enum Order {
    Xyzw,
    Wxyz,
    XyzwInverse,
    WxyzInverse,
}

/// Set-up of a lab.
#[derive(Clone, Copy)]
struct Setup {
    /// Streamed room coordinates from ours.
    stream_from_world: Matrix,
    /// Object coordinates from forward, left, up.
    object_from_flu: Matrix,
    /// Angle of the object's x axis, clockwise from the nose, seen from above. [deg]
    nose_deg: f64,
    order: Order,
    /// Streamed units per metre.
    per_m: f64,
}

const USUAL: Setup = Setup {
    stream_from_world: SAME_AXES,
    object_from_flu: SAME_AXES,
    nose_deg: 0.0,
    order: Order::Xyzw,
    per_m: 1.0,
};

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

fn transposed(a: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

/// Rotation about z, to the left. [rad]
fn yawed(rad: f64) -> Matrix {
    let (s, c) = rad.sin_cos();
    [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
}

/// Rotation about y, nose up. [rad]
fn pitched(rad: f64) -> Matrix {
    let (s, c) = rad.sin_cos();
    [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
}

/// Rotation about x, left side up. [rad]
fn rolled(rad: f64) -> Matrix {
    let (s, c) = rad.sin_cos();
    [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
}

/// Returns x, y, z, w of a rotation matrix (Shepperd).
fn quaternion(m: &Matrix) -> [f64; 4] {
    let trace = m[0][0] + m[1][1] + m[2][2];
    let squared = [m[0][0], m[1][1], m[2][2], trace].map(|d| 1.0 + 2.0 * d - trace);
    let largest = (0..4).max_by(|&a, &b| squared[a].total_cmp(&squared[b])).unwrap();
    let mut q = [0.0; 4];
    q[largest] = squared[largest].sqrt() / 2.0;
    let quarter = 4.0 * q[largest];
    for (other, value) in q.iter_mut().enumerate().filter(|(other, _)| *other != largest) {
        let (a, b) = (largest.min(other), largest.max(other));
        *value = if b == 3 {
            // With w: differences across the diagonal.
            let (j, k) = ((a + 1) % 3, (a + 2) % 3);
            (m[k][j] - m[j][k]) / quarter
        } else {
            (m[a][b] + m[b][a]) / quarter
        };
    }
    q
}

impl Setup {
    /// Returns a packet of a vehicle at a position [m], with this attitude (forward, left, up to east, north,
    /// up).
    fn packet(&self, p_m: [f64; 3], world_from_flu: &Matrix) -> String {
        let to = &self.stream_from_world;
        let p: [f64; 3] =
            std::array::from_fn(|i| (0..3).map(|j| to[i][j] * p_m[j]).sum::<f64>() * self.per_m);
        let object = product(&self.object_from_flu, &yawed(self.nose_deg.to_radians()));
        let [x, y, z, w] = quaternion(&product(&product(to, world_from_flu), &transposed(&object)));
        let q = match self.order {
            Order::Xyzw => [x, y, z, w],
            Order::Wxyz => [w, x, y, z],
            Order::XyzwInverse => [-x, -y, -z, w],
            Order::WxyzInverse => [w, -x, -y, -z],
        };
        format!(
            r#"{{"vizflyt_pose": 1, "object": "v", "position_m": {p:?}, "rotation_xyzw": {q:?}}}"#
        )
    }
}

/// Motions of the user, starting with heading `yaw_rad`: positions and attitudes at 50 Hz. The hand is not
/// exact: it pushes 4 degrees off, and tilts a little.
fn carried(yaw_rad: f64) -> Vec<([f64; 3], Matrix)> {
    // Up [m], ahead [m], left [rad], nose up [rad], left side up [rad]
    let held: [[f64; 5]; 6] = [
        [0.0, 0.0, 0.0, 0.01, 0.0],
        [0.45, 0.03, 0.05, 0.03, -0.02],
        [0.47, 0.6, -0.08, -0.04, 0.05],
        [0.5, 0.63, 1.45, 0.03, 0.04],
        [0.48, 0.6, 1.5, 0.5, -0.05],
        [0.49, 0.6, 1.55, 0.06, 0.55],
    ];
    let mut poses = Vec::new();
    let mut before = held[0];
    for now in held {
        for tick in 0..120u32 {
            let share = (f64::from(tick) / 60.0).min(1.0);
            let [up, ahead, left, nose, side] =
                std::array::from_fn(|i| before[i] + (now[i] - before[i]) * share);
            // Tremor, the same in every run. [m]
            let shake = [tick * 7 % 5, tick * 3 % 7, tick % 3].map(|v| f64::from(v) * 2e-4);
            let (sin, cos) = (yaw_rad + 0.07).sin_cos();
            let p_m = [1.0 + cos * ahead + shake[0], sin * ahead + shake[1] - 2.0, up + shake[2]];
            let attitude = product(&yawed(yaw_rad + left), &product(&pitched(nose), &rolled(side)));
            poses.push((p_m, attitude));
        }
        before = now;
    }
    poses
}

fn read(stream: &mut JsonStream, tick: usize, packet: &str) -> Pose<World, Body> {
    let now = ServerTime::from_ns(1_000_000_000 + tick as u64 * 20_000_000);
    stream.handle_packet(now, packet.as_bytes())[0].world_from_body
}

/// Runs the check for a vehicle of a lab on a server with these settings; returns the number of steps, and the
/// diagnosis.
fn look(setup: &Setup, set: &str, yaw_rad: f64) -> (usize, Diagnosis) {
    let config = LocalizationConfig::parse(set).unwrap();
    let mut stream = JsonStream::new(&config, 0, &["v"]);
    let mut check = Check::new(config);
    for (tick, (p_m, attitude)) in carried(yaw_rad).into_iter().enumerate() {
        let pose = read(&mut stream, tick, &setup.packet(p_m, &attitude));
        check.handle_pose(tick as f64 * 0.02, &pose);
    }
    assert_eq!(check.step(), HandCheckStep::Done, "{set}: {:?}", check.rests);
    (check.rests.len(), check.diagnosis())
}

/// Returns whether the settings give the true attitudes of a stream, except for one common rotation about the
/// vertical axis; the nose within `nose_deg`.
fn is_true(setup: &Setup, set: &str, nose_deg: f64) -> bool {
    let config = LocalizationConfig::parse(set).unwrap();
    let mut stream = JsonStream::new(&config, 0, &["v"]);
    let mut turns = Vec::new();
    for step in 1..40 {
        let [a, b, c] = [1.7, 2.3, 3.1].map(|by| f64::from(step) * by);
        let truth = product(&yawed(a), &product(&pitched(b), &rolled(c)));
        let p_m = [a.sin(), b.sin(), c.sin()];
        let pose = read(&mut stream, step as usize, &setup.packet(p_m, &truth));
        let up: [f64; 3] = std::array::from_fn(|i| truth[i][2]);
        let ahead: [f64; 3] = std::array::from_fn(|i| truth[i][0]);
        // The height is compared exactly; the direction in the floor plane gives the rotation.
        let found_up = pose.rotate(DVec3::Z);
        let found_ahead = pose.rotate(DVec3::X);
        if (found_up.z - up[2]).abs() > 1e-6
            || (found_ahead.z - ahead[2]).abs() > nose_deg.to_radians().max(1e-6)
            || (pose.translation_m.z - p_m[2]).abs() > 1e-6
        {
            return false;
        }
        let p = pose.translation_m;
        for (found, truth) in [(found_up, up), (p, p_m)] {
            // Vertical directions have no component in the floor plane.
            if truth[0].hypot(truth[1]) > 0.05 {
                turns.push(wrap_pi(found.y.atan2(found.x) - truth[1].atan2(truth[0])));
            }
        }
    }
    turns.iter().all(|turn| wrap_pi(turn - turns[0]).abs() < 1e-6)
}

/// Runs the check from many headings: it must give the expected change, which leaves no further change, and
/// which is the truth.
fn check(name: &str, setup: Setup, set: &str, expected: &[(&str, &str)]) {
    for step in 0..12 {
        let yaw_rad = f64::from(step) * 0.52 - 3.0;
        let (_, found) = look(&setup, set, yaw_rad);
        let about = format!("{name} as {set}, from {yaw_rad:.2} rad: {found:#?}");
        assert!(found.others.is_empty(), "{about}");
        assert_eq!(found.faults.is_empty(), expected.is_empty(), "{about}");
        let mut mended = set.to_owned();
        for (key, value) in &found.change {
            let _ = write!(mended, ",{key}={value}");
        }
        assert_eq!(found.change.len(), expected.len(), "{about}");
        for ((key, value), (wanted, like)) in found.change.iter().zip(expected) {
            assert_eq!(key, wanted, "{about}");
            // The nose is as accurate as a push.
            match (value.parse::<f64>(), like.parse::<f64>()) {
                (Ok(value), Ok(like)) => assert!((value - like).abs() < 10.0, "{about}"),
                _ => assert_eq!(value, like, "{about}"),
            }
        }
        let (_, again) = look(&setup, &mended, yaw_rad);
        assert_eq!(again, Diagnosis::default(), "{mended}: {about}");
        let nose_deg = if setup.nose_deg % 90.0 == 0.0 { 0.0 } else { 10.0 };
        assert!(is_true(&setup, &mended, nose_deg), "{mended}: {about}");
    }
}

#[test]
fn keeps_correct_settings() {
    check("usual", USUAL, "json", &[]);
    check(
        "Motive",
        Setup { stream_from_world: Y_UP, object_from_flu: Y_UP, ..USUAL },
        "json,up=y",
        &[],
    );
    let ned = Setup { stream_from_world: NED, object_from_flu: FRD, ..USUAL };
    check("NED", ned, "json,axes=yx-z,body=frd", &[]);
    check("nose", Setup { nose_deg: 45.0, ..USUAL }, "json,nose=45", &[]);
    check("w first", Setup { order: Order::Wxyz, ..USUAL }, "json,quaternion=wxyz", &[]);
}

#[test]
fn units_axes_and_noses_are_found() {
    let motive = Setup { stream_from_world: Y_UP, object_from_flu: Y_UP, ..USUAL };
    check("Motive", motive, "json", &[("up", "y")]);
    check(
        "Motive, millimetres",
        Setup { per_m: 1e3, ..motive },
        "json",
        &[("units", "mm"), ("up", "y")],
    );
    check("millimetres", Setup { per_m: 1e3, ..USUAL }, "json", &[("units", "mm")]);
    check("centimetres", Setup { per_m: 1e2, ..USUAL }, "json", &[("units", "cm")]);
    let mirror = Setup { stream_from_world: MIRROR, object_from_flu: MIRROR, ..USUAL };
    check("mirror", mirror, "json", &[("axes", "x-yz")]);
    let unity = Setup { stream_from_world: UNITY, object_from_flu: UNITY, ..USUAL };
    check("Unity", unity, "json", &[("axes", "z-xy")]);
    for (nose_deg, nose) in [(90.0, "y"), (180.0, "-x"), (-90.0, "-y")] {
        check("nose", Setup { nose_deg, ..USUAL }, "json", &[("nose", nose)]);
    }
}

#[test]
fn the_order_of_a_quaternion_is_found() {
    for (order, name) in [
        (Order::Wxyz, "wxyz"),
        (Order::XyzwInverse, "xyzw-inverse"),
        (Order::WxyzInverse, "wxyz-inverse"),
    ] {
        check(name, Setup { order, ..USUAL }, "json", &[("quaternion", name)]);
        let mm = Setup { order, per_m: 1e3, ..USUAL };
        check(name, mm, "json", &[("units", "mm"), ("quaternion", name)]);
        let turned = Setup { order, nose_deg: 90.0, ..USUAL };
        check(name, turned, "json", &[("quaternion", name), ("nose", "y")]);
    }
    check("usual", USUAL, "json,quaternion=wxyz", &[("quaternion", "xyzw")]);
}

#[test]
fn an_autopilots_axes_are_found() {
    let frd = Setup { object_from_flu: FRD, ..USUAL };
    check("FRD in ENU", frd, "json", &[("body", "frd")]);
    check(
        "FRD in ENU, w first",
        Setup { order: Order::Wxyz, ..frd },
        "json",
        &[("body", "frd"), ("quaternion", "wxyz")],
    );
    let ned = Setup { stream_from_world: NED, object_from_flu: FRD, ..USUAL };
    // North along x is the smallest change: the motions do not show which wall is x.
    check("NED", ned, "json", &[("axes", "x-y-z")]);
    // Equivalent to body = "frd" there.
    check("NED", ned, "json,axes=yx-z", &[("nose", "y")]);
    check("usual", USUAL, "json,body=frd", &[("body", "flu")]);
    let level = Setup { stream_from_world: Y_UP, ..USUAL };
    check("FLU under y up", level, "json", &[("up", "y"), ("body", "flu")]);
}

#[test]
fn a_nose_at_any_angle_is_found() {
    for nose_deg in [45.0, -45.0, 30.0, 135.0, -120.0, 60.0] {
        let name = format!("{nose_deg}");
        check(&name, Setup { nose_deg, ..USUAL }, "json", &[("nose", &name)]);
    }
    let mm = Setup { nose_deg: 45.0, per_m: 1e3, ..USUAL };
    check("45, millimetres", mm, "json", &[("units", "mm"), ("nose", "45")]);
    let motive = Setup { stream_from_world: Y_UP, object_from_flu: Y_UP, nose_deg: 45.0, ..USUAL };
    check("45, Motive", motive, "json", &[("up", "y"), ("nose", "45")]);
    let frd = Setup { object_from_flu: FRD, nose_deg: 45.0, ..USUAL };
    check("45, FRD", frd, "json", &[("body", "frd"), ("nose", "45")]);
}

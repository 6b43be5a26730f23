//! Two tables of `docs/BENCHMARKS.md`: missed and false obstacles by voxel size, and speed and error of VizFlyt's check
//! compared with the published one, on scenes with known geometry.
//!
//! The published check tests 10 x 10 points on a sphere around the vehicle, once per image. A collision is a distance
//! below a threshold from any of them to the centre of any splat. As the original, it uses a k-d tree of the centres.
//!
//! `cargo bench -p vizflyt-scenes --bench collision`

#[path = "../tests/judge/mod.rs"]
mod judge;

use std::hint::black_box;
use std::time::Instant;

use glam::{DQuat, DVec3, Vec3};
use judge::{BODY_M, CROWNS_M, FLOWN_M, Places, bake};
use vizflyt_arena::BodyShape;
use vizflyt_arena::collision::sweep;
use vizflyt_protocol::geometry::Pose;
use vizflyt_scenes::{Generated, SceneKind, generate};

fn main() {
    let forest = generate(SceneKind::Forest, 7);
    let race = generate(SceneKind::Race, 7);
    let scenes =
        [("forest", &forest, FLOWN_M), ("its crowns", &forest, CROWNS_M), ("race", &race, FLOWN_M)];
    println!("| scene | voxel | memory | bake | missed beyond 1 voxel | false alarms beyond 1.5 |");
    println!("|---|---|---|---|---|---|");
    for (kind, scene, heights) in &scenes {
        let places = Places::draw(scene, heights, 50_000, 1);
        for voxel_m in [0.03, 0.04, 0.05, 0.08, 0.1] {
            let start = Instant::now();
            let field = bake(scene, voxel_m);
            let took_s = start.elapsed().as_secs_f64();
            let touches = |p| !(field.obstacle_distance_m(p) > BODY_M);
            let score = places.judge(voxel_m, 1.5 * voxel_m, touches);
            println!(
                "| {kind} | {:.0} cm | {:.1} MB | {took_s:.2} s | {} of {} | {:.2} % of {} |",
                100.0 * voxel_m,
                field.memory_bytes() as f64 / 1e6,
                score.missed,
                score.touching,
                score.alarm_percent(),
                score.clear
            );
        }
    }
    println!();
    println!(
        "| scene | method | prepared in | a check | missed beyond 5 cm | false alarms beyond 7.5 cm |"
    );
    println!("|---|---|---|---|---|---|");
    compare("forest", &forest);
    compare("race", &race);
}

/// Prints a row for each method.
fn compare(kind: &str, scene: &Generated) {
    let places = Places::draw(scene, &FLOWN_M, 20_000, 2);
    let row = |method: &str, prepared_s: f64, touches: &mut dyn FnMut(DVec3) -> bool| {
        let start = Instant::now();
        let mut checks = 0u32;
        for p in places.points() {
            black_box(touches(p));
            checks += 1;
        }
        let check_us = start.elapsed().as_secs_f64() * 1e6 / f64::from(checks);
        let score = places.judge(0.05, 0.075, touches);
        println!(
            "| {kind} | {method} | {prepared_s:.2} s | {check_us:.2} us | {:.2} % | {:.2} % |",
            score.missed_percent(),
            score.alarm_percent()
        );
    };
    let start = Instant::now();
    let field = bake(scene, 0.05);
    let prepared_s = start.elapsed().as_secs_f64();
    row("distance field, one pose", prepared_s, &mut |p| !(field.obstacle_distance_m(p) > BODY_M));
    let body = BodyShape::sphere(BODY_M);
    row("distance field, swept 3 cm to the pose", prepared_s, &mut |p| {
        let from = Pose::new(p - DVec3::X * 0.03, DQuat::IDENTITY);
        let found = sweep(&field, &body, &from, &Pose::new(p, DQuat::IDENTITY));
        found.contact.is_some()
    });
    let start = Instant::now();
    let tree = Tree::of(scene.splats.means_m.clone());
    let prepared_s = start.elapsed().as_secs_f64();
    for threshold_m in [0.01, 0.05] {
        let name = format!("published: points on a sphere, {:.0} cm", 100.0 * threshold_m);
        row(&name, prepared_s, &mut |p| {
            sphere(p.as_vec3(), BODY_M as f32).any(|at| tree.has_within(at, threshold_m))
        });
    }
}

/// Returns 10 x 10 points by longitude and latitude.
fn sphere(center: Vec3, radius: f32) -> impl Iterator<Item = Vec3> {
    (0..100).map(move |n| {
        let longitude = (n % 10) as f32 / 10.0 * std::f32::consts::TAU;
        let latitude = (n / 10) as f32 / 9.0 * std::f32::consts::PI;
        let (ring, up) = (latitude.sin(), latitude.cos());
        center + radius * Vec3::new(ring * longitude.cos(), ring * longitude.sin(), up)
    })
}

/// Balanced k-d tree in place: the middle of a slice is its root, and the depth determines the axis.
struct Tree(Vec<Vec3>);

impl Tree {
    fn of(mut points: Vec<Vec3>) -> Self {
        fn sort(points: &mut [Vec3], axis: usize) {
            if points.len() > 1 {
                let middle = points.len() / 2;
                points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
                let (low, high) = points.split_at_mut(middle);
                sort(low, (axis + 1) % 3);
                sort(&mut high[1..], (axis + 1) % 3);
            }
        }
        sort(&mut points, 0);
        Self(points)
    }

    /// Whether a point lies within a distance. It gives the result of the published check, but ends earlier than a
    /// search for the minimum distance.
    fn has_within(&self, at: Vec3, distance: f32) -> bool {
        fn search(points: &[Vec3], axis: usize, at: Vec3, distance: f32) -> bool {
            if points.is_empty() {
                return false;
            }
            let middle = points.len() / 2;
            let root = points[middle];
            let aside = at[axis] - root[axis];
            let (near, far) = if aside < 0.0 {
                (&points[..middle], &points[middle + 1..])
            } else {
                (&points[middle + 1..], &points[..middle])
            };
            root.distance_squared(at) < distance * distance
                || search(near, (axis + 1) % 3, at, distance)
                || aside.abs() < distance && search(far, (axis + 1) % 3, at, distance)
        }
        search(&self.0, 0, at, distance)
    }
}

//! Bake, query and swept tick of the collision rules, on a forest of Gaussians.
//!
//! `cargo bench -p vizflyt-arena`

use criterion::{Criterion, criterion_group, criterion_main};
use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_arena::collision::sweep;
use vizflyt_arena::config::{BodyPart, MotionConfig, ObjectConfig};
use vizflyt_arena::grid::Grid;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_arena::obstacles::{Obstacles, TimedPose};
use vizflyt_arena::{BakeSpec, BodyShape, DistanceField, Ellipsoid, OccupancyGrid};
use vizflyt_protocol::geometry::Pose;

/// Trunks of flat Gaussians over 40 m x 14 m, with `splats` Gaussians in total.
fn forest(splats: usize) -> Vec<Ellipsoid> {
    (0..splats)
        .map(|i| {
            let (trunk, part) = (i % 60, i / 60);
            let angle = (part * 7 % 40) as f32 / 40.0 * std::f32::consts::TAU;
            let normal = Vec3::new(angle.cos(), angle.sin(), 0.0);
            let root = Vec3::new(
                (trunk * 37 % 400) as f32 * 0.1,
                (trunk * 53 % 140) as f32 * 0.1 - 7.0,
                0.0,
            );
            Ellipsoid {
                center_m: root + normal * 0.2 + Vec3::Z * ((part * 13 % 400) as f32 * 0.01),
                scales_m: Vec3::new(0.03, 0.03, 0.006),
                rotation: Quat::from_rotation_arc(Vec3::Z, normal),
                opacity: 0.95,
            }
        })
        .collect()
}

/// The clock hand: a bar of 1.2 m that turns about x in 4 s, at flight height above the origin.
fn clock_hand() -> (DistanceField, MovingObjects) {
    let grid = Grid::covering(DVec3::new(-0.3, -0.3, -0.9), DVec3::new(0.3, 0.3, 0.9), 0.02);
    let bar = (0..600).map(|i| Ellipsoid {
        center_m: Vec3::new(
            (i % 3) as f32 * 0.02 - 0.02,
            (i / 3 % 5) as f32 * 0.02 - 0.04,
            (i / 15) as f32 * 0.03 - 0.6,
        ),
        scales_m: Vec3::splat(0.012),
        rotation: Quat::IDENTITY,
        opacity: 0.95,
    });
    let hand = ObjectConfig {
        name: "hand".into(),
        scene: "hand.ply".into(),
        position_m: DVec3::new(0.0, 0.0, 1.2),
        yaw_deg: 0.0,
        phase_s: Some(0.0),
        motion: Some(MotionConfig::Rotation { axis: DVec3::X, period_s: 4.0 }),
    };
    let field = DistanceField::of(OccupancyGrid::bake_object(bar, grid, 0.3));
    (field, MovingObjects::of(&[hand], 7))
}

fn spec() -> BakeSpec {
    let grid = Grid::covering(DVec3::new(-1.5, -7.5, 0.0), DVec3::new(41.5, 7.5, 4.5), 0.05);
    BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 }
}

fn rules(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("bake");
    group.sample_size(10);
    for splats in [130_000, 1_000_000] {
        let forest = forest(splats);
        group.bench_function(format!("{splats} splats, 5 cm, 43 x 15 x 4.5 m"), |bencher| {
            bencher
                .iter(|| DistanceField::of(OccupancyGrid::bake(forest.iter().copied(), &spec())));
        });
    }
    group.finish();
    let field = DistanceField::of(OccupancyGrid::bake(forest(130_000), &spec()));
    println!("the field occupies {:.1} MB", field.memory_bytes() as f64 / 1e6);
    let mut x_m = 0.0;
    let mut next = move || {
        x_m = (x_m + 0.37) % 40.0;
        DVec3::new(x_m, (x_m * 3.1) % 12.0 - 6.0, 1.2)
    };
    criterion.bench_function("query", |bencher| {
        bencher.iter(|| field.obstacle_distance_m(next()));
    });
    // Arms of a frame with rotors, and the hub: 37 balls.
    let arm = |y_m: f64| BodyPart {
        from_m: DVec3::new(-0.09, -y_m, 0.0),
        to_m: Some(DVec3::new(0.09, y_m, 0.0)),
        radius_m: 0.03,
    };
    let hub = BodyPart { from_m: DVec3::ZERO, to_m: None, radius_m: 0.05 };
    let frame = BodyShape::of_parts(&[arm(0.09), arm(-0.09), hub]);
    let (hand, objects) = clock_hand();
    let empty = DistanceField::of(OccupancyGrid::bake(std::iter::empty(), &spec()));
    let turning = Obstacles::new(empty.into(), vec![hand.into()], objects);
    for (name, body) in [("sphere", BodyShape::sphere(0.12)), ("two arms and a hub", frame.clone())]
    {
        let mut tick = 0;
        criterion.bench_function(&format!("swept tick beside a turning hand, {name}"), |bencher| {
            bencher.iter(|| {
                // Past the hand's face, 0.2 to 0.8 m in front of it, like a vehicle that waits for a gap.
                tick = (tick + 1) % 800;
                let timed_pose = |tick: i64| {
                    let before_m = 0.5 + 0.3 * (tick as f64 * 0.01).sin();
                    let at_m = DVec3::new(-before_m, 0.1, 1.2);
                    let world_from_body =
                        Pose::new(at_m, DQuat::from_rotation_z(tick as f64 * 1e-3));
                    TimedPose { since_epoch_ns: tick * 5_000_000, world_from_body }
                };
                turning.sweep(&body, &timed_pose(tick), &timed_pose(tick + 1))
            });
        });
    }
    for (name, body) in [("sphere", BodyShape::sphere(0.12)), ("two arms and a hub", frame)] {
        criterion.bench_function(&format!("swept tick, {name}, 6 m/s at 200 Hz"), |bencher| {
            bencher.iter(|| {
                let from = Pose::new(next(), DQuat::from_rotation_z(0.3));
                let to_m = from.translation_m + DVec3::X * 0.03;
                sweep(&field, &body, &from, &Pose::new(to_m, DQuat::from_rotation_z(0.33)))
            });
        });
    }
}

criterion_group!(benches, rules);
criterion_main!(benches);

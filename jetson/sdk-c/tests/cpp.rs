//! Tests the C++ example, built with the header and the static library, on real shared memory.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::ipc::{RuntimeEnd, SERVICE_OPTION};
use vizflyt_sdk::protocol::messages::{FromPlugin, ToPlugin, bounded};
use vizflyt_sdk::{
    ArenaInfo, Axes, CameraInfo, GivenReading, HostTime, ImageStamps, Intrinsics, LidarPoint,
    Limits, ObservationWriter, Pose, RangeReading, SensorInfo, SensorKind, Setpoint, Volume,
    YawTarget,
};
use zerocopy::IntoBytes;

const WAIT: Duration = Duration::from_secs(20);

/// Returns the newest static library in the folder of this test.
fn library() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let deps = test.parent().unwrap();
    let is_ours = |path: &Path| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        name.starts_with("libvizflyt_c") && path.extension().is_some_and(|e| e == "a")
    };
    let found = deps.read_dir().unwrap().filter_map(|entry| Some(entry.ok()?.path()));
    let newest = found
        .filter(|path| is_ours(path))
        .max_by_key(|path| path.metadata().and_then(|m| m.modified()).ok());
    newest.unwrap_or_else(|| panic!("no libvizflyt_c.a in {}", deps.display()))
}

fn build(folder: &Path) -> PathBuf {
    let crate_folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = folder.join("brake");
    let built = Command::new("c++")
        .args(["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-o"])
        .arg(&program)
        .arg(crate_folder.join("examples/brake.cpp"))
        .arg("-I")
        .arg(crate_folder.join("include"))
        .arg(library())
        .args(["-lpthread", "-ldl", "-lm"])
        .output()
        .expect("a C++ compiler: apt-get install g++");
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    program
}

fn arena() -> ArenaInfo {
    let hall = Volume::aabb(DVec3::splat(-9.0), DVec3::splat(9.0));
    let intrinsics = Intrinsics::from_horizontal_fov(64, 48, 1.5);
    ArenaInfo {
        no_fly: [Volume::aabb(DVec3::ZERO, DVec3::ONE)].into_iter().collect(),
        floor_z_m: 0.25,
        ground_truth: false,
        // The plugin finds its camera by name.
        cameras: ["rear", "front"]
            .map(|name| CameraInfo::forward(name, intrinsics))
            .into_iter()
            .collect(),
        ..ArenaInfo::new("hall", hall, Limits::new(3.0, 4.0))
    }
}

fn sensors() -> [SensorInfo; 2] {
    [("top", SensorKind::Lidar, 4), ("ahead", SensorKind::RangeFinder, 1)].map(
        |(name, kind, most_records)| SensorInfo {
            name: bounded(name),
            kind,
            enabled: true,
            to_autopilot: false,
            rate_hz: 10.0,
            min_range_m: 0.1,
            max_range_m: 10.0,
            horizontal_fov_rad: 0.1,
            vertical_fov_rad: 0.1,
            most_records,
            body_from_sensor: Pose::IDENTITY,
        },
    )
}

struct Rig {
    ipc: RuntimeEnd,
    child: Child,
    seq: u64,
    /// Measurement of the range finder; 0 means no return. [m]
    range_m: f32,
    points: Vec<LidarPoint>,
}

impl Drop for Rig {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Rig {
    fn start(program: &Path) -> Self {
        let ipc = RuntimeEnd::new(ObservationWriter::len_for(&arena().cameras));
        let offer = ipc.offer_unlisted().unwrap();
        let child = Command::new(program)
            .arg(format!("{SERVICE_OPTION}={}", offer.service()))
            .env(
                vizflyt_sdk::MAP_VARIABLE,
                r#"[{"sphere": {"center_m": [1, 2, 3], "radius_m": 0.5}}]"#,
            )
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut rig = Self { ipc, child, seq: 0, range_m: 0.0, points: Vec::new() };
        let until = Instant::now() + WAIT;
        while !rig.ipc.plugin_attached() {
            assert!(Instant::now() < until && rig.child.try_wait().unwrap().is_none());
            std::thread::yield_now();
        }
        rig.ipc.send(&ToPlugin::Start(arena())).unwrap();
        assert!(matches!(rig.next(), FromPlugin::Ready { .. }));
        rig
    }

    fn next(&self) -> FromPlugin {
        let until = Instant::now() + WAIT;
        loop {
            if let Some(message) = self.ipc.receive().unwrap() {
                return message;
            }
            assert!(Instant::now() < until, "the plugin sends nothing");
            self.ipc.wait(Duration::from_millis(50)).unwrap();
        }
    }

    /// Shows the front camera an image with this depth; returns the reply.
    fn see(&mut self, depth_mm: u16) -> Option<Setpoint> {
        self.seq += 1;
        let cameras = &arena().cameras;
        let len = ObservationWriter::len_for(cameras) + ObservationWriter::sensors_len(&sensors());
        let mut loan = self.ipc.loan(len).unwrap();
        let mut writer = ObservationWriter::new(loan.memory(), self.seq, cameras).unwrap();
        if depth_mm > 0 {
            writer.planes(1, &cameras[1]).unwrap().depth_mm.fill(depth_mm);
            writer.image_ready(1, &cameras[1], ImageStamps::default());
        }
        let given = |records| GivenReading {
            seq: 1,
            pose: HostTime::ZERO,
            shown: HostTime::ZERO,
            ready: HostTime::ZERO,
            body_from_sensor: Pose::IDENTITY,
            world_from_body: None,
            records,
        };
        let range = RangeReading { range_m: self.range_m, signal: 1.0 };
        let readings = [
            (!self.points.is_empty()).then(|| given(self.points.as_bytes())),
            Some(given(range.as_bytes())),
        ];
        writer.sensors(&sensors(), &readings);
        self.ipc.publish(loan).unwrap();
        let FromPlugin::Reply { seq, setpoint, .. } = self.next() else { panic!("no answer") };
        assert_eq!(seq, self.seq);
        setpoint
    }
}

#[test]
fn cpp_plugin_attaches_and_replies_to_observations() {
    let folder = tempfile::tempdir().unwrap();
    let mut rig = Rig::start(&build(folder.path()));
    assert_eq!(rig.see(0), None, "no image of the front camera yet");
    let ahead = |speed_mps: f64, yaw| {
        let v_mps = DVec3::X * speed_mps;
        Some(Setpoint::Velocity { v_mps, axes: Axes::Heading, yaw })
    };
    assert_eq!(rig.see(9000), ahead(1.0, YawTarget::Keep));
    assert_eq!(rig.see(2000), ahead(0.5, YawTarget::Keep));
    assert_eq!(rig.see(900), ahead(0.0, YawTarget::Rate(0.5)));
    // Other sensors: the nearest return of all sensors counts.
    rig.range_m = 2.0;
    assert_eq!(rig.see(9000), ahead(0.5, YawTarget::Keep));
    let at = |x: f32, y: f32| LidarPoint { p_m: [x, y, 0.1], ..LidarPoint::default() };
    rig.points = vec![at(5.0, 0.0), at(1.5, -0.2), at(0.5, 3.0)];
    assert_eq!(rig.see(9000), ahead(0.25, YawTarget::Keep));
    rig.ipc.send(&ToPlugin::Stop).unwrap();
    let mut output = String::new();
    std::io::Read::read_to_string(rig.child.stdout.as_mut().unwrap(), &mut output).unwrap();
    assert!(rig.child.wait().unwrap().success());
    assert_eq!(
        output,
        "flying in hall: floor at 0.25 m, 1 no-fly boxes, a map of 1, velocities allowed\nstopped after 5 images\n"
    );
}

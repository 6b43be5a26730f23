//! `arena.toml`: the room, the vehicle's body, the course and the limits, as validated types.
//!
//! [`ArenaConfig::parse`] reads the text. It rejects unknown keys (with line and column) and invalid values
//! (with key, value and what to do). The scene generator builds the same struct and writes it with
//! [`ArenaConfig::to_toml`]; the server turns it into [`ArenaInfo`] for the runtime. Safety limits have no
//! default: if one is absent, the file is rejected.

use std::path::{Path, PathBuf};

use glam::{DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Body, Pose, Volume, World};
use vizflyt_protocol::messages::{
    ArenaInfo, Limits, MAX_CAMERAS, MAX_NO_FLY, PoseAges, SetpointKind, SetpointKinds, bounded,
};

use crate::pose::PoseConfig;

mod body;
mod camera;
mod environment;
pub mod imaging;
mod line;
mod no_fly;
mod object;
mod rules;
mod scene;
mod sensor;
pub(crate) mod validate;
mod vehicle;

pub use body::BodyPart;
pub use camera::CameraConfig;
pub use environment::{
    CloudConfig, EnvironmentConfig, FlickerConfig, LampPositions, LampsConfig, MAX_LAMPS,
    OwnLightConfig, RainConfig, SnowConfig, SunConfig,
};
pub use imaging::ImagingConfig;
pub use line::line_of;
pub use no_fly::NoFly;
pub use object::{MAX_OBJECTS, MotionConfig, ObjectConfig};
pub use rules::RulesConfig;
pub use scene::{METRES_PER_UNIT, SceneConfig, UnknownAxis, Up};
pub use sensor::SensorConfig;
pub use validate::{ConfigError, check_number, check_position, invalid};
pub use vehicle::{MAX_VEHICLES, VehicleConfig};

/// All of `arena.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArenaConfig {
    /// Name of the arena; at most 32 bytes.
    pub name: String,
    /// Splat scene that cameras see, and its placement in the world.
    pub scene: SceneConfig,
    /// Radius of the sphere that encloses the vehicle. [m]
    pub body_radius_m: f64,
    /// Height above the spawn to which the vehicle climbs before the plugin takes over. [m]
    pub takeoff_height_m: f64,
    /// Maximum flight time after take-off; 0 disables the limit. [s]
    #[serde(default)]
    pub time_limit_s: f64,
    /// Whether plugins receive the vehicle's pose and velocity.
    #[serde(default = "yes")]
    pub ground_truth: bool,
    /// Whether plugins may send attitude rates.
    #[serde(default)]
    pub attitude_rate: bool,
    /// Position and heading of the vehicle at the start.
    pub spawn: Spawn,
    /// Position at which the flight ends; without it, the flight ends with the last stage.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub goal: Option<Goal>,
    /// Box that the body's surface must not leave, along the world's axes.
    pub geofence: Geofence,
    /// Limits that the guard enforces on every setpoint.
    pub limits: Limits,
    /// Parts of the vehicle's body, up to 16; without them, the body is a sphere of `body_radius_m`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub body: Vec<BodyPart>,
    /// Boxes that the body's surface must not enter, up to 8.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub no_fly: Vec<NoFly>,
    /// Conversion of the scene into obstacles: a grid of cubes (voxels), each solid or free.
    #[serde(default)]
    pub occupancy: Occupancy,
    /// Light, air and weather, as the cameras see them; without it, the scene looks as captured.
    #[serde(default, skip_serializing_if = "EnvironmentConfig::is_default")]
    pub environment: EnvironmentConfig,
    /// Fusion of poses, timeouts for lost poses, and the instant for which images are rendered.
    #[serde(default, skip_serializing_if = "PoseConfig::is_default")]
    pub pose: PoseConfig,
    /// Cameras, 1 to 8, in the order of their index in messages.
    pub cameras: Vec<CameraConfig>,
    /// Sensors other than cameras, up to 8, in the order of their index in messages.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sensors: Vec<SensorConfig>,
    /// Vehicles, up to 8; without them, the server's command line names the vehicles.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub vehicles: Vec<VehicleConfig>,
    /// Sources of poses, up to 8; without them, Vicon at port 51001.
    // Unparsed: the server reads these settings.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub localization: Vec<toml::Table>,
    /// Stages (gates) of the course, in the order of flight.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<StageConfig>,
    /// Penalties, in seconds added to the time, and the setpoints that plugins may use.
    #[serde(default, skip_serializing_if = "RulesConfig::is_default")]
    pub rules: RulesConfig,
    /// Objects that are not part of the scene, fixed or moving, up to 32.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub objects: Vec<ObjectConfig>,
}

/// `[spawn]`: position and heading of the vehicle at the start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spawn {
    /// Position on the floor. [m, world]
    pub position_m: DVec3,
    /// Heading of the nose: from x, counter-clockwise. [deg, world]
    #[serde(default)]
    pub yaw_deg: f64,
}

/// `[goal]`: position at which the flight ends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Goal {
    /// Position to reach. [m, world]
    pub position_m: DVec3,
    /// Maximum distance of the body's centre from the position. [m]
    pub radius_m: f64,
}

/// `[geofence]`: an axis-aligned box that the body's surface must not leave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Geofence {
    /// Corner with the smallest x, y and z. [m, world]
    pub min_m: DVec3,
    /// Opposite corner. [m, world]
    pub max_m: DVec3,
}

/// `[occupancy]`: how obstacles are baked from the scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Occupancy {
    /// Side of a voxel. [m]
    pub voxel_m: f64,
    /// Minimum opacity of a splat that counts as an obstacle.
    pub min_opacity: f64,
    /// Height of the floor; everything below is solid. [m, world]
    pub floor_z_m: f64,
    /// Minimum density of splats in a floating component, that is, without contact to the floor or the boundary of
    /// the grid. Components below it count as artefacts of the scene, not as obstacles; 0 keeps all. [1/m^3]
    pub min_splats_per_m3: f64,
    /// Treatment of space that no photo of the capture has seen, according to the file next to the scene.
    #[serde(skip_serializing_if = "Unseen::is_free")]
    pub unseen: Unseen,
}

/// State of unseen space for the referee.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unseen {
    /// Free if it contains no splat, even if no photo has seen it.
    #[default]
    Free,
    /// Solid: a vehicle in unseen space has collided.
    Solid,
}

impl Unseen {
    #[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
    fn is_free(&self) -> bool {
        *self == Self::Free
    }
}

impl Default for Occupancy {
    /// A voxel of 5 cm resolves a thin trunk at 1 byte. An opacity of 0.3 is below that of trained surfaces and
    /// above that of trained haze. The floor is the world's z = 0. A surface of splats of 0.2 m still has 300
    /// splats in a cubic metre of its voxels; a blob of haze has fewer than 5.
    fn default() -> Self {
        Self {
            voxel_m: 0.05,
            min_opacity: 0.3,
            floor_z_m: 0.0,
            min_splats_per_m3: 30.0,
            unseen: Unseen::Free,
        }
    }
}

/// `[[stages]]`: an opening to fly through: a rectangle, or a polygon in it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StageConfig {
    /// Name of the stage; at most 32 bytes.
    pub name: String,
    /// Centre of the opening. [m, world]
    pub center_m: DVec3,
    /// Direction of passage; any length but 0. [world]
    pub normal: DVec3,
    /// Horizontal width of the opening; at least the body's. [m]
    pub width_m: f64,
    /// Height of the opening, perpendicular to width and normal; at least the body's. [m]
    pub height_m: f64,
    /// Corners of the opening, 3 to 128, within width and height. Seen in the direction of passage, x is the
    /// distance to the left of the centre, y the distance above it. Without corners, the opening is the
    /// rectangle. [m]
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub polygon_m: Vec<DVec2>,
    /// Depth of the opening along the direction of passage, centred on `center_m`. The passage counts when the
    /// vehicle has passed both faces. [m]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub thickness_m: f64,
    /// Minimum distance of the body's centre from the edge of the opening; at most half of the shorter side.
    /// [m]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub clearance_m: f64,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl ArenaConfig {
    /// Reads `arena.toml` and checks every value.
    ///
    /// ```
    /// let text = r#"
    /// name = "room"
    /// scene = "scene.ply"
    /// body_radius_m = 0.12
    /// takeoff_height_m = 1.2
    /// spawn = { position_m = [1, 2, 0] }
    /// geofence = { min_m = [0, 0, -0.5], max_m = [11, 4.5, 3.65] }
    /// limits = { max_speed_mps = 3.0, max_acceleration_mps2 = 6.0 }
    /// [[cameras]]
    /// name = "front"
    /// width_px = 320
    /// height_px = 240
    /// horizontal_fov_deg = 90.0
    /// position_m = [0.06, 0, 0.02]
    /// "#;
    /// let arena = vizflyt_arena::ArenaConfig::parse(text).unwrap();
    /// assert!((arena.cameras[0].intrinsics().fx_px - 160.0).abs() < 1e-9);
    /// let wrong = text.replace("11, 4.5, 3.65", "-11, 4.5, 3.65");
    /// let error = vizflyt_arena::ArenaConfig::parse(&wrong).unwrap_err().to_string();
    /// assert!(error.starts_with("geofence.max_m = [-11, 4.5, 3.65]"), "{error}");
    /// ```
    ///
    /// [`ConfigError::Toml`] with line and column for syntax, types, absent and unknown keys;
    /// [`ConfigError::Invalid`] for invalid values, with the line of the key.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let config: Self = vizflyt_toml::parse(text)?;
        config.validate().map_err(|error| error.in_text(text))?;
        Ok(config)
    }

    /// Returns the text of `arena.toml` that parses to the same value.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        Ok(toml::to_string(self)?)
    }

    /// Returns the path of the scene file, given the path of `arena.toml`.
    pub fn scene_path(&self, arena_toml: &Path) -> PathBuf {
        arena_toml.parent().unwrap_or(Path::new("")).join(&self.scene.file)
    }

    /// Returns the volume that the body's surface must not leave. [world]
    pub fn geofence(&self) -> Volume {
        Volume::aabb(self.geofence.min_m, self.geofence.max_m)
    }

    /// Returns the pose of the vehicle at the start: level on the floor, with heading `yaw_deg`.
    pub fn world_from_body_at_spawn(&self) -> Pose<World, Body> {
        let yaw_rad = self.spawn.yaw_deg.to_radians();
        Pose::new(self.spawn.position_m, DQuat::from_rotation_z(yaw_rad))
    }

    /// Returns the kinds of setpoint that plugins may use.
    pub fn setpoints(&self) -> SetpointKinds {
        let usual =
            if self.ground_truth { SetpointKinds::USUAL } else { SetpointKinds::BY_OWN_SENSES };
        let allowed = self.rules.setpoints.unwrap_or(usual);
        if self.attitude_rate { allowed.with(SetpointKind::AttitudeRate) } else { allowed }
    }

    /// Returns the data that the runtime needs, without the sensors: only the server has their models. For a
    /// validated config, no list is truncated.
    pub fn info(&self) -> ArenaInfo {
        ArenaInfo {
            name: bounded(&self.name),
            geofence: self.geofence(),
            no_fly: self.no_fly.iter().map(NoFly::volume).take(MAX_NO_FLY).collect(),
            floor_z_m: self.occupancy.floor_z_m,
            limits: self.limits,
            body_radius_m: self.body_radius_m,
            takeoff_height_m: self.takeoff_height_m,
            goal_m: self.goal.map(|goal| goal.position_m),
            goal_radius_m: self.goal.map_or(0.0, |goal| goal.radius_m),
            time_limit_s: self.time_limit_s,
            start_box: self.rules.start_box.map(|start| Volume::aabb(start.min_m, start.max_m)),
            ground_truth: self.ground_truth,
            pose_ages: PoseAges {
                hold_after_s: self.pose.hold_after_s,
                land_after_s: self.pose.land_after_s,
            },
            setpoints: self.setpoints(),
            cameras: self.cameras.iter().map(CameraConfig::info).take(MAX_CAMERAS).collect(),
            // Resolved when the scene loads: only the server has the names of models.
            sensors: [].into_iter().collect(),
        }
    }
}

/// Default of `ground_truth`: hiding the pose takes an explicit setting.
fn yes() -> bool {
    true
}

#[cfg(test)]
mod tests;

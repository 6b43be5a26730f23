//! `arena.toml`: the room, the vehicle's body, the course and the limits, as validated types.
//!
//! Text comes in through [`ArenaConfig::parse`], which refuses unknown keys (with line and
//! column) and values that cannot work (with key, value and what to do). The scene generator
//! builds the same struct and writes it with [`ArenaConfig::to_toml`]; the server turns it into
//! [`ArenaInfo`] for the runtime. Safety limits have no default: absent is an error.

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

/// The whole of `arena.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArenaConfig {
    /// The arena's name; at most 32 bytes.
    pub name: String,
    /// The splats that the room is seen as, and how they lie in the world.
    pub scene: SceneConfig,
    /// Radius of the sphere that encloses the vehicle. [m]
    pub body_radius_m: f64,
    /// Height above the spawn to which the vehicle climbs before the plugin flies it. [m]
    pub takeoff_height_m: f64,
    /// So long after take-off the flight is over; 0 is never. [s]
    #[serde(default)]
    pub time_limit_s: f64,
    /// Whether plugins get the vehicle's pose and velocity; by default they do.
    #[serde(default = "yes")]
    pub ground_truth: bool,
    /// Whether plugins may fly by attitude rates; by default they may not.
    #[serde(default)]
    pub attitude_rate: bool,
    /// Where the vehicle stands at the start.
    pub spawn: Spawn,
    /// Where the flight shall end; without one it ends with the last stage.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub goal: Option<Goal>,
    /// The box that the body's surface must not leave, along the world's axes.
    pub geofence: Geofence,
    /// What the guard enforces, whatever a plugin asks.
    pub limits: Limits,
    /// Parts of the vehicle, up to 16; without any, it is the sphere of `body_radius_m`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub body: Vec<BodyPart>,
    /// Boxes that the body's surface must stay out of, up to 8.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub no_fly: Vec<NoFly>,
    /// How obstacles are made of the scene: in a grid of cubes (voxels), each solid or free.
    #[serde(default)]
    pub occupancy: Occupancy,
    /// Light, air and weather, for the cameras alone; without it, the scene is as it was captured.
    #[serde(default, skip_serializing_if = "EnvironmentConfig::is_default")]
    pub environment: EnvironmentConfig,
    /// How poses are fused, when they count as lost, and for which moment images are rendered.
    #[serde(default, skip_serializing_if = "PoseConfig::is_default")]
    pub pose: PoseConfig,
    /// The cameras, 1 to 8, in the order of their index in messages.
    pub cameras: Vec<CameraConfig>,
    /// The sensors beside the cameras, up to 8, in the order of their index in messages.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sensors: Vec<SensorConfig>,
    /// The vehicles, up to 8; without any, the server's command line names them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub vehicles: Vec<VehicleConfig>,
    /// Where poses come from, up to 8 sources; without any, Vicon at port 51001.
    // As the file has it: the settings are the server's, which reads them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub localization: Vec<toml::Table>,
    /// The course's gates in order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<StageConfig>,
    /// What a flight is fined for, in seconds that are added to its time, and what plugins may ask for.
    #[serde(default, skip_serializing_if = "RulesConfig::is_default")]
    pub rules: RulesConfig,
    /// What stands or moves in the room and is no part of its scene, up to 32.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub objects: Vec<ObjectConfig>,
}

/// `[spawn]`: where the vehicle stands at the start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spawn {
    /// Where it stands on the floor. [m, world]
    pub position_m: DVec3,
    /// Where its nose points: from x, counter-clockwise. [deg, world]
    #[serde(default)]
    pub yaw_deg: f64,
}

/// `[goal]`: where the flight shall end.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Goal {
    /// The point that shall be reached. [m, world]
    pub position_m: DVec3,
    /// How near the body's centre must come. [m]
    pub radius_m: f64,
}

/// `[geofence]`: an axis-aligned box that the body's surface must not leave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Geofence {
    /// The corner with the least x, y and z. [m, world]
    pub min_m: DVec3,
    /// The corner opposite. [m, world]
    pub max_m: DVec3,
}

/// `[occupancy]`: how obstacles are baked from the scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Occupancy {
    /// Side of a voxel. [m]
    pub voxel_m: f64,
    /// Splats fainter than this are no obstacle.
    pub min_opacity: f64,
    /// Height of the floor; below is solid. [m, world]
    pub floor_z_m: f64,
    /// What hangs in the air with fewer splats than this in its volume is taken for a fault of the scene, and is no
    /// obstacle; 0 keeps all. [1/m^3]
    pub min_splats_per_m3: f64,
    /// What space counts as that no photo of the capture has looked into, as the file beside the scene says.
    #[serde(skip_serializing_if = "Unseen::is_free")]
    pub unseen: Unseen,
}

/// What a referee takes unseen space for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unseen {
    /// Free where no splat stands, whether anybody has looked there or not.
    #[default]
    Free,
    /// Solid: who flies where nobody has looked has collided.
    Solid,
}

impl Unseen {
    #[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
    fn is_free(&self) -> bool {
        *self == Self::Free
    }
}

impl Default for Occupancy {
    /// 5 cm resolves a thin trunk at 1 byte a voxel; 0.3 is below what trained surfaces have and
    /// above what trained haze has; the floor is the world's z = 0. A surface of splats as large as
    /// 0.2 m still has 300 in a cubic metre of its voxels, a blob of haze fewer than 5.
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
    /// Its name; at most 32 bytes.
    pub name: String,
    /// Centre of the opening. [m, world]
    pub center_m: DVec3,
    /// Direction in which it is flown through; any length but 0. [world]
    pub normal: DVec3,
    /// Width of the opening, level; not less than the body's. [m]
    pub width_m: f64,
    /// Its height, across width and normal; not less than the body's. [m]
    pub height_m: f64,
    /// Corners of the opening, 3 to 128: to the left and up from its centre as one flies through; within
    /// width and height. Without any it is the rectangle. [m]
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub polygon_m: Vec<DVec2>,
    /// Depth of the opening along the passage, its centre in the middle: it counts when both its faces
    /// were passed. [m]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub thickness_m: f64,
    /// What the body's centre must keep from the opening's edge for the passage to count; at most half of the lesser side. [m]
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
    /// # Errors
    /// [`ConfigError::Toml`] with line and column for syntax, types, absent and unknown keys;
    /// [`ConfigError::Invalid`] for values that cannot work, with the line of the key.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let config: Self = vizflyt_toml::parse(text)?;
        config.validate().map_err(|error| error.in_text(text))?;
        Ok(config)
    }

    /// Returns the text of `arena.toml` that parses to the same value.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        Ok(toml::to_string(self)?)
    }

    /// Returns where the scene file lies, given where `arena.toml` lies.
    pub fn scene_path(&self, arena_toml: &Path) -> PathBuf {
        arena_toml.parent().unwrap_or(Path::new("")).join(&self.scene.file)
    }

    /// Returns the keep-in volume for the body's surface. [world]
    pub fn geofence(&self) -> Volume {
        Volume::aabb(self.geofence.min_m, self.geofence.max_m)
    }

    /// Returns the pose of the vehicle at the start: level on the floor, nose by `yaw_deg`.
    pub fn world_from_body_at_spawn(&self) -> Pose<World, Body> {
        let yaw_rad = self.spawn.yaw_deg.to_radians();
        Pose::new(self.spawn.position_m, DQuat::from_rotation_z(yaw_rad))
    }

    /// Returns what plugins may ask for.
    pub fn setpoints(&self) -> SetpointKinds {
        let usual =
            if self.ground_truth { SetpointKinds::USUAL } else { SetpointKinds::BY_OWN_SENSES };
        let allowed = self.rules.setpoints.unwrap_or(usual);
        if self.attitude_rate { allowed.with(SetpointKind::AttitudeRate) } else { allowed }
    }

    /// Returns what the runtime must know, but for the sensors, whose models the server knows. Of a validated config
    /// nothing is cut.
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
            // Which they are is resolved as the scene loads: names of models are the server's.
            sensors: [].into_iter().collect(),
        }
    }
}

/// Default of `ground_truth`: a course withholds it on purpose.
fn yes() -> bool {
    true
}

#[cfg(test)]
mod tests;

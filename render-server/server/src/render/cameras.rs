//! Current cameras of a vehicle; they can be changed with the page and the API.
//!
//! The render thread takes the newest set at each tick, and every image keeps the camera with which it was
//! rendered. So a change takes effect at the next tick, and no image is skipped or mislabelled. Sessions and
//! pages receive each change.

use std::sync::Arc;

use serde_json::{Map, Value};
use tokio::sync::watch;
use vizflyt_arena::config::{CameraConfig, ConfigError};
use vizflyt_protocol::messages::{CameraInfo, MAX_CAMERAS};
use vizflyt_protocol::sensor::SensorKind;

/// All cameras of a vehicle, in the order of their index in the protocol.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraSet {
    /// Settings as in `arena.toml`.
    pub configs: Vec<CameraConfig>,
    /// Data sent to the runtime.
    pub infos: Vec<CameraInfo>,
}

impl CameraSet {
    fn of(mut configs: Vec<CameraConfig>) -> Self {
        configs.truncate(MAX_CAMERAS);
        let infos = configs.iter().map(CameraConfig::info).collect();
        Self { configs, infos }
    }

    /// Returns the cameras with width and height divided by `by`, and the same view.
    fn shrunk(&self, by: u32) -> Self {
        let mut shrunk = self.clone();
        for info in &mut shrunk.infos {
            info.intrinsics = info.intrinsics.shrunk(by);
        }
        shrunk
    }
}

/// Cameras of one vehicle as rendered: smaller if the link is slow.
#[derive(Debug, Default)]
pub struct RenderedCameras {
    of: Arc<CameraSet>,
    by: u32,
    shrunk: Arc<CameraSet>,
}

impl RenderedCameras {
    /// Returns `newest` with width and height divided by `by`; updated only when either changes.
    pub fn follow(&mut self, newest: Arc<CameraSet>, by: u32) -> Arc<CameraSet> {
        if by <= 1 {
            return newest;
        }
        if self.by != by || !Arc::ptr_eq(&self.of, &newest) {
            self.shrunk = Arc::new(newest.shrunk(by));
            (self.of, self.by) = (newest, by);
        }
        self.shrunk.clone()
    }
}

/// Cameras of one vehicle, shared by all threads.
#[derive(Debug)]
pub struct Cameras(watch::Sender<Arc<CameraSet>>);

/// Why a change is rejected.
#[derive(Debug, thiserror::Error)]
pub enum ChangeError {
    /// No camera has this name.
    #[error("there is no camera '{name}'; there are {}", known.join(", "))]
    Unknown {
        /// Requested name.
        name: String,
        /// Existing names.
        known: Vec<String>,
    },
    /// No sensor has this name.
    #[error("there is no sensor '{name}'; there are {}", known.join(", "))]
    UnknownSensor {
        /// Requested name.
        name: String,
        /// Existing names.
        known: Vec<String>,
    },
    /// The kind of a sensor is fixed in flight, because plugins expect its records.
    #[error("model = {model:?} is a {is}, and the sensor a {was}; it stays one while flying")]
    Kind {
        /// Requested model.
        model: String,
        /// Kind of the model.
        is: SensorKind,
        /// Kind of the sensor.
        was: SensorKind,
    },
    /// The text is not valid JSON of a camera.
    #[error("settings cannot be read: {0}")]
    Json(serde_json::Error),
    /// Invalid value.
    #[error(transparent)]
    Value(#[from] ConfigError),
    /// The name is fixed in flight, because plugins identify cameras by name.
    #[error("name = {0:?}: a camera or sensor keeps its name while flying; leave `name` out")]
    Renamed(String),
    /// Rendering would take so long that the vehicle flies without images.
    #[error(
        "width_px x height_px = {0}x{1}: too large to change to while flying; give at most \
         {MAX_PIXELS} pixels, as 3840x2160"
    )]
    Pixels(u32, u32),
}

impl From<serde_json::Error> for ChangeError {
    fn from(error: serde_json::Error) -> Self {
        Self::Json(error)
    }
}

impl Cameras {
    /// Creates the cameras of an arena; at most [`MAX_CAMERAS`].
    pub fn new(configs: Vec<CameraConfig>) -> Self {
        Self(watch::Sender::new(Arc::new(CameraSet::of(configs))))
    }

    /// Returns the current cameras.
    pub fn newest(&self) -> Arc<CameraSet> {
        self.0.borrow().clone()
    }

    /// Returns a receiver of every later change.
    pub fn subscribe(&self) -> watch::Receiver<Arc<CameraSet>> {
        self.0.subscribe()
    }

    /// Replaces the camera `name` with `json`: the keys of `[[cameras]]` in `arena.toml`.
    pub fn put(&self, name: &str, json: &[u8]) -> Result<CameraConfig, ChangeError> {
        self.change(name, |_| Ok(serde_json::from_slice(json)?))
    }

    /// Changes the keys in `json` of the camera `name`; null removes a key (RFC 7396, JSON merge patch). A
    /// field of view replaces a calibration, and vice versa.
    pub fn patch(&self, name: &str, json: &[u8]) -> Result<CameraConfig, ChangeError> {
        self.change(name, |old| {
            let patch: Map<String, Value> = serde_json::from_slice(json)?;
            let has = |key: &&str| patch.get(*key).is_some_and(|value| !value.is_null());
            let mut new: Map<String, Value> = serde_json::from_value(serde_json::to_value(old)?)?;
            if has(&FIELD_OF_VIEW) {
                new.retain(|key, _| !CALIBRATION.contains(&key.as_str()));
            } else if CALIBRATION.iter().any(has) {
                new.remove(FIELD_OF_VIEW);
            }
            for (key, value) in patch {
                if value.is_null() {
                    new.remove(&key);
                } else {
                    new.insert(key, value);
                }
            }
            Ok(Value::Object(new))
        })
    }

    fn change(
        &self,
        name: &str,
        make: impl FnOnce(&CameraConfig) -> Result<Value, ChangeError>,
    ) -> Result<CameraConfig, ChangeError> {
        let mut result = None;
        // Under the lock, so that two concurrent changes do not overwrite each other.
        self.0.send_if_modified(|set| {
            let changed = changed(set, name, make);
            let modified = changed.as_ref().is_ok_and(|(index, new)| set.configs[*index] != *new);
            if let (true, Ok((index, new))) = (modified, &changed) {
                let mut configs = set.configs.clone();
                configs[*index] = new.clone();
                *set = Arc::new(CameraSet::of(configs));
            }
            result = Some(changed.map(|(_, new)| new));
            modified
        });
        result.expect("the closure ran")
    }
}

fn changed(
    set: &CameraSet,
    name: &str,
    make: impl FnOnce(&CameraConfig) -> Result<Value, ChangeError>,
) -> Result<(usize, CameraConfig), ChangeError> {
    let known = || set.configs.iter().map(|camera| camera.name.clone()).collect();
    let index = set.configs.iter().position(|camera| camera.name == name);
    let index =
        index.ok_or_else(|| ChangeError::Unknown { name: name.to_owned(), known: known() })?;
    let mut value = make(&set.configs[index])?;
    if let Value::Object(keys) = &mut value {
        keys.entry("name").or_insert_with(|| name.into());
    }
    let mut new: CameraConfig = serde_json::from_value(value)?;
    // Depth that the course withholds cannot be enabled.
    new.depth &= set.configs[index].depth;
    if new.name != name {
        return Err(ChangeError::Renamed(new.name));
    }
    new.validate()?;
    if u64::from(new.width_px) * u64::from(new.height_px) > MAX_PIXELS {
        return Err(ChangeError::Pixels(new.width_px, new.height_px));
    }
    Ok((index, new))
}

const FIELD_OF_VIEW: &str = "horizontal_fov_deg";
const CALIBRATION: [&str; 5] = ["fx_px", "fy_px", "cx_px", "cy_px", "distortion"];
/// Maximum pixels: 4K takes a small machine a second, and 40 MB of shared memory.
const MAX_PIXELS: u64 = 3840 * 2160;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn cameras() -> Cameras {
        let camera = |name| CameraConfig::ahead(name, [320, 240], 90.0, DVec3::X * 0.06);
        Cameras::new(vec![camera("front"), camera("rear")])
    }

    fn refused(result: Result<CameraConfig, ChangeError>, expected: &str) {
        let error = result.unwrap_err().to_string();
        assert!(error.contains(expected), "'{error}' lacks '{expected}'");
    }

    #[test]
    fn slow_links_get_smaller_images_of_the_same_view() {
        let cameras = Cameras::new(vec![CameraConfig::ahead("a", [640, 480], 90.0, DVec3::ZERO)]);
        let (newest, mut rendered) = (cameras.newest(), RenderedCameras::default());
        assert!(Arc::ptr_eq(&rendered.follow(newest.clone(), 1), &newest));
        let half = rendered.follow(newest.clone(), 2);
        let (k, full) = (half.infos[0].intrinsics, newest.infos[0].intrinsics);
        assert_eq!((k.width_px, k.height_px, k.fx_px), (320, 240, full.fx_px / 2.0));
        assert!(Arc::ptr_eq(&rendered.follow(newest.clone(), 2), &half), "made once");
        assert_eq!(rendered.follow(newest.clone(), 3).infos[0].intrinsics.width_px, 213);
        assert!(Arc::ptr_eq(&rendered.follow(newest.clone(), 1), &newest), "and back");
    }

    #[test]
    fn patch_changes_only_its_keys() {
        let cameras = cameras();
        let mut watcher = cameras.subscribe();
        let new = cameras.patch("rear", br#"{"width_px": 640, "tilt_deg": 15}"#).unwrap();
        assert_eq!((new.width_px, new.height_px, new.tilt_deg), (640, 240, 15.0));
        assert!(watcher.has_changed().unwrap());
        let set = watcher.borrow_and_update().clone();
        assert_eq!(set.infos[1].intrinsics.width_px, 640);
        assert_eq!(set.infos[0], super::CameraSet::of(set.configs.clone()).infos[0]);
        // An identical patch is not a change.
        cameras.patch("rear", br#"{"width_px": 640}"#).unwrap();
        assert!(!watcher.has_changed().unwrap());
        cameras.patch("rear", br#"{"rate_hz": 10}"#).unwrap();
        cameras.patch("rear", br#"{"rate_hz": null}"#).unwrap();
        assert_eq!(cameras.newest().configs[1].rate_hz, None);
    }

    #[test]
    fn field_of_view_and_calibration_replace_each_other() {
        let cameras = cameras();
        let json = br#"{"fx_px": 200, "fy_px": 201, "cx_px": 160.5, "cy_px": 119,
                        "distortion": {"model": "brown-conrady", "k1": -0.1}}"#;
        let new = cameras.patch("front", json).unwrap();
        assert_eq!((new.horizontal_fov_deg, new.fy_px), (None, Some(201.0)));
        let new = cameras.patch("front", br#"{"horizontal_fov_deg": 60}"#).unwrap();
        assert_eq!((new.horizontal_fov_deg, new.fx_px, new.distortion), (Some(60.0), None, None));
    }

    #[test]
    fn an_image_sensor_is_set_and_removed() {
        let cameras = cameras();
        let json = br#"{"imaging": {"sensor": "imx219", "depth": {"model": "d435"}}}"#;
        let new = cameras.patch("front", json).unwrap();
        assert_eq!(new.imaging.unwrap().describe(), "imx219, depth d435");
        let json = br#"{"imaging": {"sensor": "ov9281"}}"#;
        assert_eq!(cameras.patch("front", json).unwrap().imaging.unwrap().describe(), "ov9281");
        assert_eq!(cameras.patch("front", br#"{"imaging": null}"#).unwrap().imaging, None);
        refused(
            cameras.patch("front", br#"{"imaging": {"sensor": "eye"}}"#),
            "imaging.sensor = \"eye\": unknown; give one of imx219",
        );
    }

    #[test]
    fn put_replaces_the_whole_camera() {
        let cameras = cameras();
        let json = br#"{"width_px": 64, "height_px": 48, "horizontal_fov_deg": 70,
                        "position_m": [0.1, 0, 0], "near_m": 0.2}"#;
        let new = cameras.put("front", json).unwrap();
        assert_eq!((new.width_px, new.near_m, new.tilt_deg), (64, 0.2, 0.0));
        refused(cameras.put("front", br#"{"width_px": 64}"#), "missing field `height_px`");
    }

    #[test]
    fn reports_errors_and_changes_nothing() {
        let cameras = cameras();
        let before = cameras.newest();
        let patch = |json: &str| cameras.patch("front", json.as_bytes());
        refused(cameras.patch("left", b"{}"), "there is no camera 'left'; there are front, rear");
        refused(patch("{"), "settings cannot be read: EOF");
        refused(patch("[1]"), "settings cannot be read: invalid type: sequence");
        refused(patch(r#"{"fov": 60}"#), "unknown field `fov`, expected one of");
        refused(patch(r#"{"width_px": "wide"}"#), "invalid type: string");
        refused(patch(r#"{"width_px": 0}"#), "width_px");
        refused(patch(r#"{"horizontal_fov_deg": 200}"#), "horizontal_fov_deg = 200");
        refused(patch(r#"{"near_m": -1}"#), "near_m = -1");
        refused(patch(r#"{"name": "nose"}"#), "keeps its name");
        refused(patch(r#"{"width_px": 8000, "height_px": 8000}"#), "8000x8000: too large");
        refused(patch(r#"{"fx_px": 100}"#), "give all of fx_px");
        assert_eq!(cameras.newest(), before);
    }
}

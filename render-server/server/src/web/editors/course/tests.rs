use axum::http::HeaderValue;
use glam::{DVec3, Quat, Vec3};
use serde_json::{Value, json};
use vizflyt_splat::CpuRenderer;

use super::super::engine::Engine;
use super::*;
use crate::scene::{WorldFromScene, default_arena};

/// Stores what it is called with.
#[derive(Default)]
struct Kept(Mutex<Vec<(Course, Vec<PathBuf>)>>);

impl CourseFile for Kept {
    fn save(&self, course: &Course, models: &[(PathBuf, Arc<Splats>)]) -> Result<Vec<Line>> {
        anyhow::ensure!(course.takeoff_height_m < 5.0, "too high for this file");
        let paths = models.iter().map(|(path, _)| path.clone()).collect();
        lock(&self.0).push((course.clone(), paths));
        Ok(vec![Line { key: "written", text: "arena.toml".to_owned() }])
    }
}

/// A floor of 6 by 4 m, and the panel of its page.
fn panel(file: Arc<Kept>) -> Arc<Panel> {
    let side = 0..24 * 16;
    let at = |k: usize| Vec3::new(0.25 * (k % 24) as f32, 0.25 * (k / 24) as f32, 0.0);
    let floor = Splats {
        means_m: side.clone().map(at).collect(),
        scales_m: vec![Vec3::new(0.2, 0.2, 0.005); side.len()],
        rotations: vec![Quat::IDENTITY; side.len()],
        opacities: vec![0.95; side.len()],
        sh_degree: 0,
        sh: vec![0.3; side.len() * 3],
        antialiased: false,
    };
    let mut arena = default_arena(&floor, "floor.ply").unwrap();
    arena.geofence =
        Geofence { min_m: DVec3::new(-0.2, -0.2, -0.5), max_m: DVec3::new(6.0, 4.0, 3.0) };
    arena.spawn = Spawn { position_m: DVec3::new(0.8, 1.8, 0.0), yaw_deg: 0.0 };
    (arena.goal, arena.takeoff_height_m) = (None, 1.0);
    let one = WorldFromScene::IDENTITY;
    let engine =
        Engine::new(Box::new(CpuRenderer::new(&floor)), MovingObjects::default(), one, one);
    let args = ViewArgs {
        scene: PathBuf::from("/nowhere/arena.toml"),
        http: "127.0.0.1:0".parse().unwrap(),
        renderer: crate::render::RendererKind::Cpu,
        detail: crate::render::DetailKind::default(),
        antialiased: scene::Antialiased::default(),
        bare: scene::BareArgs::default(),
        seed: 0,
        no_browser: true,
    };
    let scene = Scene {
        arena,
        splats: floor,
        objects: Vec::new(),
        world_from_scene: one,
        seen: None,
        packed: None,
    };
    Arc::new(Panel::new(Arc::new(Mutex::new(engine)), scene, file, args))
}

async fn ask(panel: &Arc<Panel>, from: &str, origin: &'static str, order: &Value) -> (u16, Value) {
    let mut headers = HeaderMap::new();
    headers.insert("host", HeaderValue::from_static("127.0.0.1:80"));
    headers.insert("origin", HeaderValue::from_static(origin));
    let from = ConnectInfo(from.parse::<SocketAddr>().unwrap());
    let response = obey(State(panel.clone()), from, headers, Ok(order.to_string().into())).await;
    let status = response.status().as_u16();
    let body = axum::body::to_bytes(response.into_body(), 1 << 20).await.unwrap();
    let text = String::from_utf8(body.to_vec()).unwrap();
    (status, serde_json::from_str(&text).unwrap_or(Value::String(text)))
}

const HERE: &str = "127.0.0.1:9";
const OURS: &str = "http://127.0.0.1:80";

fn with_gate(course: &Value, x_m: f64, model: &str) -> Value {
    let mut course = course.clone();
    course["stages"] = json!([{
        "name": "gate 1", "center_m": [x_m, 1.8, 1.0], "normal": [1, 0, 0], "width_m": 1.2, "height_m": 1.0,
    }]);
    course["objects"] = json!([{
        "name": "gate 1 frame", "scene": model, "position_m": [x_m, 1.8, 1.0], "yaw_deg": 0,
    }]);
    course
}

#[tokio::test]
async fn a_gate_is_shown_checked_and_saved_with_its_frame() {
    let kept = Arc::new(Kept::default());
    let panel = panel(kept.clone());
    let (status, opened) = ask(&panel, HERE, OURS, &json!("open")).await;
    assert_eq!((status, &opened["findings"]), (200, &json!([])), "{opened}");
    let gate = with_gate(&opened["course"], 3.0, "models/gate-120x100.ply");
    let (_, looked) = ask(&panel, HERE, OURS, &json!({"look": gate})).await;
    assert_eq!(looked["findings"], json!([]), "{looked}");
    let room_m = looked["least_room_m"].as_f64().unwrap();
    // Half of the opening's height, minus the body.
    let body_m = looked["body_radius_m"].as_f64().unwrap();
    assert!((room_m - (0.5 - body_m)).abs() < 0.06, "{room_m}");
    // The image contains it: its left bar is 2 m ahead and 0.63 m to the left.
    let request = serde_json::from_value(json!({
        "p_m": [1.0, 1.8, 1.0], "yaw_rad": f64::atan2(0.63, 2.0), "pitch_rad": 0, "fov_deg": 15, "width_px": 320,
        "height_px": 320, "depth": false,
    }));
    let picked = lock(&panel.engine).pick(&request.unwrap(), glam::DVec2::splat(160.0)).unwrap();
    let depth_m = picked.unwrap().depth_m;
    assert!((depth_m - f64::hypot(1.97, 0.63)).abs() < 0.05, "{depth_m}");
    // Before saving, a newly opened page starts with the course of the file.
    assert_eq!(ask(&panel, HERE, OURS, &json!("open")).await.1["course"], opened["course"]);
    // A bar that blocks the path is found.
    let mut low = gate.clone();
    low["stages"][0]["center_m"][2] = json!(1.5);
    let (_, found) = ask(&panel, HERE, OURS, &json!({"look": low})).await;
    assert!(found["findings"][0]["text"].as_str().unwrap().contains("'gate 1 frame'"), "{found}");
    let (_, saved) = ask(&panel, HERE, OURS, &json!({"save": gate})).await;
    assert_eq!(saved["said"][0]["key"], "written", "{saved}");
    ask(&panel, HERE, OURS, &json!({"save": gate})).await;
    let kept = lock(&kept.0);
    assert_eq!(kept[0].0.stages[0].name, "gate 1");
    assert_eq!(kept[0].1, [PathBuf::from("/nowhere/models/gate-120x100.ply")]);
    assert!(kept[1].1.is_empty(), "a model is written once");
}

#[tokio::test]
async fn an_invalid_course_is_rejected_by_key_and_changes_nothing() {
    let kept = Arc::new(Kept::default());
    let panel = panel(kept.clone());
    let (_, opened) = ask(&panel, HERE, OURS, &json!("open")).await;
    let course = &opened["course"];
    let mut wrong = course.clone();
    wrong["spawn"]["position_m"] = json!([90, 0, 0]);
    let (status, report) = ask(&panel, HERE, OURS, &json!({"save": wrong})).await;
    assert_eq!(
        (status, &report["findings"][0]["key"]),
        (200, &json!("spawn.position_m")),
        "{report}"
    );
    let gone = with_gate(course, 3.0, "../frame.ply");
    let (_, report) = ask(&panel, HERE, OURS, &json!({"save": gone})).await;
    assert_eq!(report["findings"][0]["key"], "objects[0].scene", "{report}");
    let mut high = course.clone();
    high["takeoff_height_m"] = json!(5.5);
    high["geofence"]["max_m"][2] = json!(9.0);
    let (status, text) = ask(&panel, HERE, OURS, &json!({"save": high})).await;
    assert_eq!((status, text), (409, json!("too high for this file")));
    assert!(lock(&kept.0).is_empty());
    assert_eq!(ask(&panel, HERE, OURS, &json!({"save": 3})).await.0, 400);
}

#[tokio::test]
async fn only_the_own_page_on_this_computer_sends_requests() {
    let panel = panel(Arc::default());
    for (from, origin, expected) in [
        (HERE, OURS, 200),
        ("[::1]:9", OURS, 200),
        ("192.168.1.4:9", OURS, 403),
        (HERE, "http://evil.example", 403),
    ] {
        assert_eq!(ask(&panel, from, origin, &json!("open")).await.0, expected, "{from} {origin}");
    }
}

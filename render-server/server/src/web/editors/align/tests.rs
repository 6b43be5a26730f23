use axum::http::HeaderValue;
use glam::{Quat, Vec3};
use vizflyt_arena::objects::MovingObjects;
use vizflyt_splat::{CpuRenderer, Splats};

use super::super::engine::Engine;
use super::*;
use crate::scene::{WorldFromScene, default_arena};

/// Accepts three points, and stores nothing.
struct Yes;

impl Aligner for Yes {
    fn solve(&self, picks: &Picks) -> Result<Solved, String> {
        if picks.floor.len() < 3 {
            return Err("too few".to_owned());
        }
        let place = Place::new(&WorldFromScene::IDENTITY);
        Ok(Solved { place, lines: Vec::new(), go: Some(true) })
    }

    fn save(&self, _: &Wish) -> Result<Vec<Line>, String> {
        Ok(vec![Line { key: "written", text: "arena.toml".to_owned() }])
    }
}

/// A wall 3 m ahead of the origin, and the panel of its page.
fn panel() -> State<Arc<Panel>> {
    let wall = Splats {
        means_m: vec![Vec3::new(3.0, 0.0, 1.0)],
        scales_m: vec![Vec3::new(0.001, 1.0, 1.0)],
        rotations: vec![Quat::IDENTITY],
        opacities: vec![1.0],
        sh_degree: 0,
        sh: vec![1.0; 3],
        antialiased: false,
    };
    let arena = default_arena(&wall, "wall.ply").unwrap();
    let one = WorldFromScene::IDENTITY;
    let renderer = Box::new(CpuRenderer::new(&wall));
    let setup = Setup::new(&arena, Place::new(&one));
    let engine = Engine::new(renderer, MovingObjects::default(), one, one);
    State(Arc::new(Panel { engine: Arc::new(Mutex::new(engine)), aligner: Arc::new(Yes), setup }))
}

fn headers(origin: &'static str) -> HeaderMap {
    let mut headers = HeaderMap::new();
    headers.insert("host", HeaderValue::from_static("127.0.0.1:80"));
    headers.insert("origin", HeaderValue::from_static(origin));
    headers
}

const OURS: &str = "http://127.0.0.1:80";
const PICKS: &str = r#"{"floor": [[0,0,0], [1,0,0], [0,1,0]], "above": [0,0,1], "length": null, "origin_at_m": [0,0,0],
    "yaw_deg": 0, "geofence": {"min_m": [0,0,0], "max_m": [1,1,1]}, "rough_m": 0}"#;

fn wish() -> String {
    format!(
        r#"{{"picks": {PICKS}, "spawn": {{"position_m": [0,0,0], "yaw_deg": 0}}, "force": false}}"#
    )
}

fn click(px: [f64; 2], yaw_rad: f64) -> Bytes {
    let [x, y] = px;
    let request = format!(
        r#"{{"p_m": [0,0,1], "yaw_rad": {yaw_rad}, "pitch_rad": 0, "fov_deg": 40, "width_px": 160, "height_px": 120, "depth": false}}"#
    );
    format!(r#"{{"request": {request}, "px": [{x}, {y}]}}"#).into()
}

async fn words(response: Response) -> (u16, String) {
    let status = response.status().as_u16();
    let body = axum::body::to_bytes(response.into_body(), 1 << 20).await.unwrap();
    (status, String::from_utf8(body.to_vec()).unwrap())
}

#[tokio::test]
async fn a_click_returns_the_wall_or_a_reason() {
    let pick =
        async |px, yaw| words(super::pick(panel(), headers(OURS), Ok(click(px, yaw))).await).await;
    let (status, text) = pick([80.0, 60.0], 0.0).await;
    assert_eq!(status, 200, "{text}");
    let found: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert!((found["p_scene"][0].as_f64().unwrap() - 3.0).abs() < 0.02, "{text}");
    for (px, yaw, expected) in [
        ([80.0, 60.0], 3.0, "nothing solid"),
        ([-1.0, 0.0], 0.0, "outside"),
        ([1e300, 0.0], 0.0, "outside"),
    ] {
        let (status, text) = pick(px, yaw).await;
        assert!(status == 422 && text.contains(expected), "{status} {text}");
    }
    let garbage = super::pick(panel(), headers(OURS), Ok("{".into())).await;
    assert_eq!(words(garbage).await.0, 400);
}

#[tokio::test]
async fn only_the_own_page_on_this_computer_writes() {
    let save = async |from: &str, origin| {
        let from = ConnectInfo(from.parse::<SocketAddr>().unwrap());
        words(super::save(panel(), from, headers(origin), Ok(wish().into())).await).await
    };
    assert_eq!(save("127.0.0.1:9", OURS).await.0, 200);
    assert_eq!(save("[::1]:9", OURS).await.0, 200);
    assert_eq!(save("[::ffff:127.0.0.1]:9", OURS).await.0, 200);
    let (status, text) = save("192.168.1.4:9", OURS).await;
    assert!(status == 403 && text.contains("this computer"), "{text}");
    assert_eq!(save("127.0.0.1:9", "http://evil.example").await.0, 403);
}

#[tokio::test]
async fn picks_are_solved_only_for_the_own_page() {
    let solve = async |origin, picks: String| {
        words(super::solve(panel(), headers(origin), Ok(picks.into())).await).await
    };
    assert_eq!(solve(OURS, PICKS.to_owned()).await.0, 200);
    assert_eq!(solve("http://evil.example", PICKS.to_owned()).await.0, 403);
    let few = PICKS.replace(", [0,1,0]]", "]");
    assert_eq!(solve(OURS, few).await, (422, "too few".to_owned()));
    let many = PICKS.replace("[[0,0,0]", &format!("[[0,0,0]{}", ", [0,0,0]".repeat(MAX_POINTS)));
    assert!(solve(OURS, many).await.1.contains("plenty"));
}

//! Two vehicles in one arena see each other, but not themselves, and collide. Also: cameras that withhold depth.

use std::fmt::Write;

use crate::support::{Client, Emitter, PATIENCE, Server, write_arena};
use quinn::TransportConfig;
use vizflyt_protocol::messages::{EventKind, ToRuntime};
use vizflyt_rgbd::Decoder;

/// Returns the depth at the centre of the next image of a camera. [mm]
async fn middle_mm(client: &Client, camera: u8) -> u16 {
    loop {
        let (header, payload) = client.image().await;
        if header.camera == camera {
            let k = header.intrinsics();
            let mut rgb = vec![0; 3 * k.pixels()];
            let mut depth_mm = vec![0; k.pixels()];
            Decoder::new().decode(&payload, &mut rgb, &mut depth_mm).unwrap();
            assert!(rgb.iter().any(|&value| value > 40), "there is colour");
            return depth_mm[(k.height_px / 2 * k.width_px + k.width_px / 2) as usize];
        }
    }
}

#[tokio::test]
async fn two_vehicles_see_each_other_and_collide() {
    let mut vehicles = String::new();
    for (name, x_m) in [("wasp", -2.0), ("bee", -6.0)] {
        let spawn = format!("spawn = {{ position_m = [{x_m}, 0, 0] }}");
        write!(vehicles, "[[vehicles]]\nname = '{name}'\n{spawn}\n").unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), &vehicles), &["--max-rate", "40"]);
    let (wasp, _) = Client::welcomed_to(&server, "wasp", TransportConfig::default()).await;
    let (mut bee, _) = Client::welcomed_to(&server, "bee", TransportConfig::default()).await;
    let _wasp_stays = Emitter::along(server.vicon, "wasp", |_| -2.0);
    // Half a second in place, then 5 mm per frame towards the wasp, and stop behind it.
    let _bee_comes = Emitter::along(server.vicon, "bee", |frame| {
        -6.0 + f64::from(frame.clamp(100, 860) - 100) * 0.005
    });
    let collision = |message| match message {
        ToRuntime::Event { event, .. } => match event.kind {
            EventKind::Collision(it) => Some((it.p_world_m, event.text)),
            _ => None,
        },
        _ => None,
    };
    let (p_world_m, text) = bee.until(collision).await;
    assert!(text.contains("collision with vehicle 'wasp'"), "{text}");
    // Twice the body radius of 0.12 m behind the wasp.
    assert!((p_world_m.x + 2.24).abs() < 0.05, "{p_world_m}");
    // The bee sees the wasp close ahead; the wasp does not see itself, only the wall.
    let close = async { while middle_mm(&bee, 0).await > 500 {} };
    tokio::time::timeout(PATIENCE, close).await.expect("the wasp is seen");
    let far_mm = middle_mm(&wasp, 0).await;
    assert!((6500..7200).contains(&far_mm), "{far_mm} mm");
}

#[tokio::test]
async fn withheld_depth_does_not_leave_the_server() {
    let colour_alone = "[[cameras]]\nname = 'colour'\nwidth_px = 160\nheight_px = 120\n\
                        horizontal_fov_deg = 90.0\nposition_m = [0.06, 0, 0.02]\ndepth = false\n";
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), colour_alone), &["--max-rate", "40"]);
    let (client, _) = Client::welcomed(&server, TransportConfig::default()).await;
    let _emitter = Emitter::along(server.vicon, "vizflyt", |_| 0.0);
    assert!((4500..5200).contains(&middle_mm(&client, 0).await));
    assert_eq!(middle_mm(&client, 1).await, 0);
    // Changing the camera does not enable depth either.
    let request = "PATCH /api/vehicles/vizflyt/cameras/colour";
    let (status, text) =
        crate::support::send_json(server.http, request, None, r#"{"depth": true}"#);
    assert_eq!(status, 200, "{text}");
    assert!(text.contains("\"depth\":false"), "{text}");
    assert_eq!(middle_mm(&client, 1).await, 0);
}

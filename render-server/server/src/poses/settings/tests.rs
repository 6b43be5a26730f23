use glam::DQuat;
use vizflyt_protocol::geometry::{Body, Pose, World};

use super::*;
use proptest::prelude::*;

fn check(text: &str, expected: &str) {
    let error = LocalizationConfig::parse(text).unwrap_err();
    assert!(error.contains(expected), "{text}: {error}");
}

#[test]
fn command_line_and_file_are_equivalent() {
    let line = "natnet:0.0.0.0:1511,up=y,units=cm,nose=-y,offset.yaw_deg=90,pivot_m=[0.0;0.0]";
    check(line, "write a position as [x,y,z]");
    let line = line.split_once(",pivot").unwrap().0;
    let found = LocalizationConfig::parse(&format!("{line},objects.bee=Body 7")).unwrap();
    let file = r#"
        driver = "natnet"
        address = "0.0.0.0:1511"
        up = "y"
        units = "cm"
        nose = "-y"
        offset = { yaw_deg = 90 }
        objects = { bee = "Body 7" }
    "#;
    assert_eq!(found, toml::from_str(file).unwrap());
    assert_eq!((found.object_of("bee"), found.object_of("ant")), ("Body 7", "ant"));
    let number = LocalizationConfig::parse("natnet,objects.bee=7").unwrap();
    assert_eq!(number.object_of("bee"), "7");
    let again: LocalizationConfig = toml::from_str(&toml::to_string(&found).unwrap()).unwrap();
    assert_eq!(again, found);
    let line = "json:0.0.0.0:5,pivot_m=[0.02,0,-0.05],offset.position_m=[1.0, -2, 0.5],offset.yaw_deg=90,objects.bee='a,b'";
    let found = LocalizationConfig::parse(line).unwrap();
    let file = r#"
        driver = "json"
        address = "0.0.0.0:5"
        pivot_m = [0.02, 0, -0.05]
        offset = { position_m = [1.0, -2, 0.5], yaw_deg = 90 }
        objects = { bee = "a,b" }
    "#;
    assert_eq!(found, toml::from_str(file).unwrap());
    let plain = LocalizationConfig::parse("vicon").unwrap();
    assert_eq!(plain, LocalizationConfig::new(Driver::Vicon));
    assert_eq!((plain.address(), plain.alignment().unit_m), ("0.0.0.0:51001", 1e-3));
}

#[test]
fn reports_invalid_settings_by_name() {
    check("vicom:1.2.3.4", "drivers are vicon, natnet, json, mavlink, vrpn");
    check("json,units=yd", "unknown variant `yd`");
    check("json,units", "write KEY=VALUE");
    check("json,units,pivot_m=[0,0,0]", "'units': write KEY=VALUE");
    check("json,pivot_m=[0,0,units=cm", "'pivot_m=[0,0,units=cm': write a position as [x,y,z]");
    check("json,pivot_m=[0;0;0]", "write a position as [x,y,z]");
    check("json,pivot_m=[0,0]", "write DRIVER:ADDRESS,KEY=VALUE");
    check("json,pivot_m=0", "write DRIVER:ADDRESS,KEY=VALUE");
    check("json,pivot_m=[0,0,nan]", "pivot_m");
    check("json,offset.position_m=[0,0,1e9]", "offset.position_m");
    check("json,axes=xxy", "name each of x, y and z once");
    check("json,axes=x-z-", "name each of x, y and z once");
    check("natnet,up=y,axes=xyz", "leave one of them out");
    check("json,euler=zyx", "only Vicon streams angles");
    check("vicon,euler=xyx", "write xyz, xzy,");
    check("json,interface=1.2.3.4", "only NatNet comes by multicast");
    check("natnet,sensor=1", "only VRPN's trackers have sensors");
    check("vrpn,sensor=-1", "expected u16");
    check("json,nose=z", "'z': write x, y, -x, -y or degrees from the object's x");
    check("json,nose=400", "nose");
    check("json,nose=nan", "nose");
    check("json,nose=[1]", "x, y, -x, -y or degrees");
    check("json,quaternion=zyxw", "write xyzw, wxyz, xyzw-inverse, wxyz-inverse");
    check("vicon,quaternion=wxyz", "vicon has no quaternions whose order could differ");
    check("mavlink,quaternion=wxyz", "mavlink has no quaternions");
    check("json,body=ned", "unknown variant `ned`");
    check("json,axes=x-yz,body=frd", "a mirrored stream has no such axes");
    check("json,offset.yaw_deg=1000", "give a number from -360 to 360");
    check("json,colour=red", "colour");
}

#[test]
fn nose_is_a_name_or_an_angle() {
    for (text, deg, again) in [
        ("x", 0.0, "x"),
        ("-y", -90.0, "-y"),
        ("45", 45.0, "45"),
        ("-30.5", -30.5, "-30.5"),
        ("90", 90.0, "y"),
    ] {
        let found = LocalizationConfig::parse(&format!("json,nose={text}")).unwrap();
        assert_eq!((found.nose.deg(), found.nose.to_string().as_str()), (deg, again));
        let file = toml::to_string(&found).unwrap();
        assert_eq!(toml::from_str::<LocalizationConfig>(&file).unwrap(), found, "{file}");
    }
    let quoted: LocalizationConfig = toml::from_str("driver = \"json\"\nnose = \"45\"").unwrap();
    assert_eq!(quoted.nose.deg(), 45.0);
}

/// Conventions of COORDINATES.md: an autopilot's frames, and w first.
#[test]
fn converts_attitudes_in_an_autopilots_axes() {
    let read = |text: &str, p: [f64; 3], came: [f64; 4]| {
        let config = LocalizationConfig::parse(text).unwrap();
        config.alignment().world_from_body(DVec3::from(p), DQuat::from_array(came))
    };
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let is = |pose: &Pose<World, Body>, nose: DVec3, up: DVec3| {
        let off = (pose.rotate(DVec3::X) - nose).length() + (pose.rotate(DVec3::Z) - up).length();
        assert!(off < 1e-9, "nose {}, up {}", pose.rotate(DVec3::X), pose.rotate(DVec3::Z));
    };
    // Level, nose to the north: no rotation from NED to FRD.
    let pose = read("json,axes=yx-z,body=frd", [2.0, 1.0, -3.0], [0.0, 0.0, 0.0, 1.0]);
    is(&pose, DVec3::Y, DVec3::Z);
    assert!((pose.translation_m - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
    // A quarter turn to the right from there is one about down: nose to the east.
    is(&read("json,axes=yx-z,body=frd", [0.0; 3], [0.0, 0.0, half, half]), DVec3::X, DVec3::Z);
    // FRD in ENU: level with the nose to the east is a half turn about x.
    is(&read("json,body=frd", [0.0; 3], [1.0, 0.0, 0.0, 0.0]), DVec3::X, DVec3::Z);
    // A quarter turn to the left about z, w first; and its conjugate.
    is(&read("json,quaternion=wxyz", [0.0; 3], [half, 0.0, 0.0, half]), DVec3::Y, DVec3::Z);
    let inverse = "json,quaternion=xyzw-inverse";
    is(&read(inverse, [0.0; 3], [0.0, 0.0, -half, half]), DVec3::Y, DVec3::Z);
    // The object's x is 45 degrees to the right of the nose.
    let nose = DVec3::new(half, half, 0.0);
    is(&read("json,nose=45", [0.0; 3], [0.0, 0.0, 0.0, 1.0]), nose, DVec3::Z);
}

#[test]
fn there_are_48_axes_half_of_them_mirrors() {
    let all: std::collections::HashSet<_> = Axes::all().collect();
    assert_eq!((all.len(), all.iter().filter(|axes| axes.is_mirror()).count()), (48, 24));
    for axes in all {
        assert_eq!(axes.to_string().parse(), Ok(axes));
    }
    assert_eq!(UpAxis::Y.axes().to_string(), "x-zy");
    assert!("x-yz".parse::<Axes>().unwrap().is_mirror());
}

fn rotation() -> impl Strategy<Value = DQuat> {
    prop::array::uniform4(-1.0..1.0f64)
        .prop_filter("too short", |q| q.iter().map(|v| v * v).sum::<f64>() > 1e-2)
        .prop_map(|q| DQuat::from_array(q).normalize())
}

fn alignment() -> impl Strategy<Value = Alignment> {
    let laid = (0usize..48, 0usize..3, 0usize..4);
    (laid, -180.0..180.0f64, -180.0..180.0f64, 0usize..3).prop_map(
        |((axes, body, quaternion), nose_deg, yaw_deg, unit)| {
            let axes = Axes::all().nth(axes).unwrap();
            Alignment {
                unit_m: Units::ALL[unit].metres(),
                axes,
                quaternion: Quaternion::ALL[quaternion],
                body: if axes.is_mirror() { BodyAxes::Stream } else { BodyAxes::ALL[body] },
                nose: Nose::from_deg(nose_deg),
                offset: Offset { position_m: DVec3::new(1.0, -2.0, 0.5), yaw_deg },
                pivot_m: DVec3::new(0.02, 0.0, 0.05),
            }
        },
    )
}

proptest! {
    /// Any text is parsed or rejected, and the result is the same after writing it to a file.
    #[test]
    fn any_text_parses_or_fails_cleanly(text in r#"json(,(pivot_m|offset.position_m|objects.a|units|x)?=?[\[\]"',0-9.a-z-]{0,12}){0,4}"#) {
        if let Ok(found) = LocalizationConfig::parse(&text) {
            let again: LocalizationConfig = toml::from_str(&toml::to_string(&found).unwrap()).unwrap();
            prop_assert_eq!(again, found);
        }
    }

    #[test]
    fn poses_survive_a_round_trip(a in alignment(), q in rotation(), p in prop::array::uniform3(-5.0..5.0f64)) {
        let pose = a.world_from_body(DVec3::from(p), q);
        prop_assert!(pose.is_valid());
        let (p_back, q_back) = a.streamed(&pose);
        prop_assert!((p_back - DVec3::from(p)).length() < 1e-6, "{p_back}");
        prop_assert!(q_back.dot(q).abs() > 1.0 - 1e-9);
    }

    /// For any axes: a point of the object is at its streamed coordinates, and the direction of rotations is
    /// right in a mirror too.
    #[test]
    fn points_of_the_object_move_with_it(a in alignment(), q in rotation(), v in prop::array::uniform3(-1.0..1.0f64)) {
        let a = Alignment { unit_m: 1.0, pivot_m: DVec3::ZERO, ..a };
        // A vector of the object in the stream's axes, and in the world's.
        let v = DVec3::from(v);
        let turn = DQuat::from_rotation_z(a.offset.yaw_deg.to_radians());
        let in_world = turn * (a.axes.matrix() * (q * v));
        let pose = a.world_from_body(DVec3::ZERO, a.quaternion.streamed(q));
        prop_assert!((pose.rotate(a.body_from_object() * v) - in_world).length() < 1e-9);
    }

    #[test]
    fn angles_survive_a_round_trip(q in rotation(), which in 0usize..7) {
        let euler = Euler::ALL[which];
        let again = euler.rotation(euler.angles(q));
        prop_assert!(again.dot(q).abs() > 1.0 - 1e-6, "{euler}");
    }

    #[test]
    fn orders_use_fixed_axes(a in prop::array::uniform3(-1.5..1.5f64)) {
        let angles = DVec3::from(a);
        let [x, y, z] = [DQuat::from_rotation_x(a[0]), DQuat::from_rotation_y(a[1]), DQuat::from_rotation_z(a[2])];
        for (euler, expected) in [
            (Euler::Xyz, z * y * x), (Euler::Xzy, y * z * x), (Euler::Yxz, z * x * y),
            (Euler::Yzx, x * z * y), (Euler::Zxy, y * x * z), (Euler::Zyx, x * y * z),
        ] {
            prop_assert!(euler.rotation(angles).dot(expected).abs() > 1.0 - 1e-9, "{}", euler);
        }
    }
}

#[test]
fn reads_the_file_strictly_and_names_the_line_of_errors() {
    let arena = "name = \"x\"\n[[localization]]\ndriver = \"vicon\"\n[[localization]]\n";
    let read = |rest: &str| read_all(&format!("{arena}{rest}")).map_err(|e| e.to_string());
    let found = read("driver = \"json\"\n").unwrap();
    assert_eq!(found.iter().map(|c| c.driver).collect::<Vec<_>>(), [Driver::Vicon, Driver::Json]);
    let unknown = read("driver = \"json\"\ncolour = 1\n").unwrap_err();
    assert!(unknown.contains("line 6") && unknown.contains("colour"), "{unknown}");
    let wrong = read("driver = \"json\"\neuler = \"zyx\"\n").unwrap_err();
    assert!(wrong.contains("localization[1].euler = zyx: only Vicon"), "{wrong}");
    assert!(wrong.contains("(line 6)"), "{wrong}");
    let many = "[[localization]]\ndriver = \"json\"\n".repeat(MAX_SOURCES + 1);
    let many = read_all(&many).unwrap_err().to_string();
    assert!(many.contains("give at most 8 [[localization]]"), "{many}");
    assert_eq!(read_all("name = \"x\"").unwrap(), []);
}

use super::*;

fn need(request: &str) -> Need {
    let (method, uri) = request.split_once(' ').unwrap();
    Need::of(&method.parse().unwrap(), &uri.parse().unwrap())
}

fn vehicle(name: &str) -> Need {
    Need::Vehicle(name.to_owned())
}

#[test]
fn every_request_takes_what_it_should() {
    for open in ["GET /", "GET /app.js", "HEAD /style.css", "GET /enter?key=x"] {
        assert_eq!(need(open), Need::Nothing, "{open}");
    }
    for any in ["GET /api/map", "GET /api/vehicles", "HEAD /api/map"] {
        assert_eq!(need(any), Need::Key, "{any}");
    }
    for own in [
        "GET /ws?vehicle=ant",
        "GET /ws?x=1&vehicle=ant",
        "GET /ws?vehicle=%61nt",
        "GET /api/stats?vehicle=ant",
        "GET /api/vehicles/ant/cameras",
        "GET /api/vehicles/%61nt/cameras",
        "POST /api/vehicles/ant/estop",
    ] {
        assert_eq!(need(own), vehicle("ant"), "{own}");
    }
    for all in [
        "GET /ws",
        "GET /ws?vehicle=ant&vehicle=bee",
        "GET /ws?vehicle=ant&%76ehicle=bee",
        "GET /ws?vehicle=%6",
        "POST /",
        "POST /app.js",
        "POST /api/estop",
        "GET /api/pairing",
        "POST /api/pairing",
        "PUT /api/vehicles/ant/cameras/front",
        "PATCH /api/vehicles/ant/cameras/front",
        "GET /api/vehicles/ant/estop",
        "GET /api/vehicles/ant/cameras/front",
        "GET /api/vehicles/ant/cameras/../../bee/cameras",
        "GET /api/of-tomorrow",
        "GET /api",
        "GET /x/app.js",
        "GET /nothing",
    ] {
        assert_eq!(need(all), Need::Everything, "{all}");
    }
}

#[test]
fn a_team_meets_its_own_vehicles_needs_alone() {
    let team = Viewer::Team("ant".to_owned());
    for (need, expected) in [
        (Need::Nothing, true),
        (Need::Key, true),
        (vehicle("ant"), true),
        (vehicle("bee"), false),
        (vehicle(""), false),
        (Need::Everything, false),
    ] {
        assert_eq!(need.is_met_by(&team), expected, "{need:?}");
        assert!(need.is_met_by(&Viewer::Instructor), "{need:?}");
    }
}

#[test]
fn who_shows_a_key_is_judged_by_it_and_who_shows_none_by_where_it_is() {
    let root = tempfile::tempdir().unwrap();
    let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
    let keys = PageKeys::keep(&folder, &["ant", "bee"]).unwrap();
    let links = keys.links("http://h", &["ant", "bee"]);
    let key = |index: usize| links[index].1.strip_prefix("http://h/enter?key=").unwrap().to_owned();
    let judge = |from: &str, cookie: &str| {
        let mut headers = HeaderMap::new();
        if !cookie.is_empty() {
            headers.insert(header::COOKIE, cookie.parse().unwrap());
        }
        keys.judge(from.parse().unwrap(), &headers)
    };
    let of = |index: usize| format!("other=1; vizflyt_key={}", key(index));
    let team = |name: &str| Some(Viewer::Team(name.to_owned()));
    for from in ["127.0.0.1", "192.168.1.7", "::1"] {
        assert_eq!(judge(from, &of(0)), Some(Viewer::Instructor));
        assert_eq!((judge(from, &of(1)), judge(from, &of(2))), (team("ant"), team("bee")));
        assert_eq!(judge(from, "vizflyt_key=wrong"), None);
        assert_eq!(judge(from, "vizflyt_key="), None);
    }
    for home in ["127.0.0.1", "::1", "::ffff:127.0.0.1"] {
        assert_eq!(judge(home, ""), Some(Viewer::Instructor));
        assert_eq!(judge(home, "other=1"), Some(Viewer::Instructor));
    }
    for away in ["192.168.1.7", "10.0.0.1", "0.0.0.0", "2001:db8::1"] {
        assert_eq!(judge(away, ""), None, "{away}");
    }
}

#[test]
fn keys_are_kept_made_for_new_vehicles_and_checked() {
    let root = tempfile::tempdir().unwrap();
    let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
    let first = PageKeys::keep(&folder, &["ant"]).unwrap().links("", &["ant"]);
    let again = PageKeys::keep(&folder, &["ant", "a 'b"]).unwrap();
    assert_eq!(again.links("", &["ant"]), first);
    assert_eq!(again.links("", &["ant", "a 'b", "bee"]).len(), 3);
    let good = folder.read_secret(FILE).unwrap().unwrap();
    for (from, to, expected) in
        [("instructor", "boss", "unknown field"), ("ant = \"", "ant = \"short\" # ", "a key is 16")]
    {
        folder.write(FILE, &good.replace(from, to)).unwrap();
        let error = PageKeys::keep(&folder, &["ant"]).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let same = "instructor = \"aaaaaaaaaaaaaaaaaaaa\"\n[vehicles]\nant = \"aaaaaaaaaaaaaaaaaaaa\"";
    folder.write(FILE, same).unwrap();
    assert!(PageKeys::keep(&folder, &[]).unwrap_err().to_string().contains("the same"));
}

#[test]
fn names_survive_the_address() {
    for name in ["ant", "a b&c=d/%", "Käfer"] {
        assert_eq!(decoded(&encoded(name)).as_deref(), Some(name));
    }
    assert_eq!((decoded("%"), decoded("%zz"), decoded("%ff")), (None, None, None));
}

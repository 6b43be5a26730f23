use axum::http::HeaderValue;

use super::*;

#[test]
fn requests_are_judged_by_key_else_by_address() {
    let root = tempfile::tempdir().unwrap();
    let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
    let access =
        |login| Access::new(&folder, &["ant", "bee"], login, Logins::new().unwrap()).unwrap();
    let (remote, always) = (access(Login::Remote), access(Login::Always));
    let links = remote.keys().links("http://h", &["ant", "bee"]);
    let key = |index: usize| links[index].1.strip_prefix("http://h/enter?key=").unwrap().to_owned();
    let judged_by = |access: &Access, from: &str, cookie: &str| {
        let mut headers = HeaderMap::new();
        if !cookie.is_empty() {
            headers.insert(header::COOKIE, cookie.parse().unwrap());
        }
        access.judge(from.parse().unwrap(), &headers).map(|shown| shown.viewer)
    };
    let judge = |from: &str, cookie: &str| judged_by(&remote, from, cookie);
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
        // An ended session counts as no session.
        assert_eq!(judge(home, "vizflyt_session=gone"), Some(Viewer::Instructor));
        assert_eq!(judged_by(&always, home, ""), None, "{home}");
        assert_eq!(judged_by(&always, home, &of(0)), Some(Viewer::Instructor));
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
    for (from, to, expected) in [
        ("instructor", "boss", "unknown field"),
        ("ant = \"", "ant = \"short\" # ", "a key has 16"),
    ] {
        folder.write(FILE, &good.replace(from, to)).unwrap();
        let error = PageKeys::keep(&folder, &["ant"]).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let same = "instructor = \"aaaaaaaaaaaaaaaaaaaa\"\n[vehicles]\nant = \"aaaaaaaaaaaaaaaaaaaa\"";
    folder.write(FILE, same).unwrap();
    assert!(PageKeys::keep(&folder, &[]).unwrap_err().to_string().contains("the same"));
}

proptest::proptest! {
    /// Malformed cookies and tokens do not panic, and open nothing.
    #[test]
    fn malformed_cookies_open_nothing(
        text in "[ -~]{0,80}",
        bytes in proptest::collection::vec(32u8..=255, 0..80),
    ) {
        let mut headers = HeaderMap::new();
        if let Ok(value) = HeaderValue::from_bytes(&bytes) {
            headers.insert(header::COOKIE, value);
        }
        let _ = (cookie(&headers, KEY), cookie(&headers, SESSION));
        let logins = Logins::new().unwrap();
        proptest::prop_assert!(!logins.tokens.fits("cookie", &text));
    }
}

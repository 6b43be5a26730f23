use super::*;
use proptest::prelude::*;

/// Parses `text` and expects an error that contains all `parts`.
fn check_refused(text: &str, parts: &[&str]) {
    let error = JetsonConfig::parse(text).expect_err(text).to_string();
    for part in parts {
        assert!(error.contains(part), "{text:?} does not contain {part:?}: {error}");
    }
    assert!(!error.contains('\n'), "one sentence: {error}");
}

#[test]
fn an_empty_file_selects_the_simulated_lab() {
    let config = JetsonConfig::parse("").unwrap();
    assert_eq!(config, JetsonConfig::default());
    assert!(config.server.is_none());
}

#[test]
fn reads_the_example_in_the_module() {
    let text = include_str!("../config.rs");
    let example: String = text
        .lines()
        .skip_while(|line| *line != "//! ```toml")
        .skip(1)
        .take_while(|line| *line != "//! ```")
        .map(|line| line.trim_start_matches("//!").to_owned() + "\n")
        .collect();
    let config = JetsonConfig::parse(&example).unwrap();
    assert_eq!(config.server.unwrap().address, "192.168.10.2:4433");
    assert_eq!(config.limits.max_speed_mps, Some(2.0));
    assert!(config.plugin.path.is_some() && config.vehicle.mavlink.is_some());
}

#[test]
fn reads_the_shipped_file() {
    let config = JetsonConfig::parse(include_str!("../../../systemd/jetson.toml")).unwrap();
    assert!(config.server.is_some() && config.plugin.path.is_some());
    // A person who deletes the server's section flies the simulated lab.
    let text = include_str!("../../../systemd/jetson.toml");
    let (before, after) = text.split_once("[server]").unwrap();
    let (_, after) = after.split_once("[vehicle]").unwrap();
    let config = JetsonConfig::parse(&format!("{before}[vehicle]{after}")).unwrap();
    assert!(config.server.is_none() && config.vehicle.mavlink.is_some());
}

#[test]
fn explains_mistakes() {
    check_refused("[limit]\n", &["line 1, column 2", "'limit'", "did you mean 'limits'"]);
    check_refused(
        "[limits]\nmax_sped_mps = 2\n",
        &["line 2, column 1", "'max_sped_mps'", "did you mean 'max_speed_mps'"],
    );
    check_refused("[server]\nadress = \"a:1\"\n", &["did you mean 'address'"]);
    check_refused(
        "[vehicle]\ncolour = 1\n",
        &["unknown key 'colour'", "known here: name, mavlink"],
    );
    check_refused("[server]\n", &["address"]);
    check_refused("[server]\naddress = \"lab\"\n", &["server.address = \"lab\"", "a port"]);
    check_refused("[vehicle]\nmavlink = \"tcp:1\"\n", &["vehicle.mavlink", "udpin:"]);
    check_refused("[vehicle]\nmavlink = \"udpin:x\"\n", &["vehicle.mavlink", "a port"]);
    check_refused("[vehicle]\nmavlink = \"serial:/dev/x:1\"\n", &["vehicle.mavlink", "serial:"]);
    check_refused("[vehicle]\nvision_hz = 100.0\n", &["vehicle.vision_hz", "from 30 to 50"]);
    check_refused("[vehicle]\nname = \"\"\n", &["vehicle.name", "1 to 32 bytes"]);
    for value in ["0", "-1", "nan", "inf", "1e9"] {
        let text = format!("[limits]\nmax_speed_mps = {value}\n");
        check_refused(&text, &["limits.max_speed_mps", "from 0.1 to 30 m/s"]);
    }
    check_refused("[limits]\nmax_speed_mps = \"2\"\n", &["line 2", "string"]);
    check_refused("[limits\n", &["line 1"]);
    check_refused("[plugin]\nmemory_mb = 1\n", &["plugin.memory_mb = 1", "give 64"]);
    check_refused("[plugin]\ncpus = nan\n", &["plugin.cpus = NaN"]);
    check_refused("[plugin]\nrestart = \"always\"\n", &["line 2", "on_ground"]);
    check_refused("[log]\nimages = \"all\"\n", &["line 2", "reduced", "full"]);
    check_refused("[log]\nkeep_gb = -1.0\n", &["log.keep_gb = -1", "from 0.1"]);
    check_refused("[log]\nkeep_days = nan\n", &["log.keep_days = NaN"]);
    check_refused("[log]\nkeep_mb = 5\n", &["did you mean 'keep_gb'"]);
}

#[test]
fn reads_the_plugins_limits_with_defaults_for_the_rest() {
    use crate::supervisor::{PluginLimits, Restart};
    let text = "[plugin]\nmemory_mb = 500\nrestart = \"in_flight\"\nnetwork = true\n";
    let found = JetsonConfig::parse(text).unwrap().plugin.limits();
    let restart = Restart::InFlight;
    let expected =
        PluginLimits { memory_mb: 500, restart, network: true, ..PluginLimits::default() };
    assert_eq!(found, expected);
}

#[test]
fn reads_the_retention_by_size_and_age() {
    let check = |text: &str, max_bytes, max_age| {
        let found = JetsonConfig::parse(text).unwrap().log.retention();
        assert_eq!(found, Retention { max_bytes, max_age }, "{text}");
    };
    check("", 20_000_000_000, None);
    let days = Some(Duration::from_hours(48));
    check("[log]\nkeep_gb = 0.5\nkeep_days = 2\n", 500_000_000, days);
    check("[log]\nkeep_gb = inf\n", u64::MAX, None);
}

#[test]
fn errors_name_the_file_and_paths_are_relative_to_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("jetson.toml");
    let error = JetsonConfig::read(&path).unwrap_err().to_string();
    assert!(error.contains("jetson.toml"), "{error}");
    std::fs::write(&path, "[plugins]\n").unwrap();
    let error = JetsonConfig::read(&path).unwrap_err().to_string();
    assert!(error.contains("jetson.toml: line 1") && error.contains("'plugin'"), "{error}");
    let text = "[server]\naddress = \"a:1\"\nkeys = \"keys\"\n[plugin]\npath = \"my/first\"\nread = [\"map\"]\nwrite = [\"/w\"]\n";
    std::fs::write(&path, text).unwrap();
    let config = JetsonConfig::read(&path).unwrap();
    assert_eq!(config.server.unwrap().keys, Some(folder.path().join("keys")));
    assert_eq!(config.plugin.path, Some(folder.path().join("my/first")));
    assert_eq!(config.plugin.read, [folder.path().join("map")]);
    assert_eq!(config.plugin.write, [PathBuf::from("/w")]);
    std::fs::write(&path, "[plugin]\npath = \"avoid\"\n").unwrap();
    assert_eq!(JetsonConfig::read(&path).unwrap().plugin.path, Some("avoid".into()));
}

#[test]
fn reports_all_mistakes_at_once() {
    let error = |text: &str| JetsonConfig::parse(text).unwrap_err().to_string();
    let keys = error("[limit]\nx = 1\n[vehicle]\nnam = 'a'\nsystem = 'b'\n");
    let lines: Vec<&str> = keys.lines().collect();
    assert_eq!(lines.len(), 3, "{keys}");
    assert!(lines[0].starts_with("line 1, column 2: unknown key 'limit'"), "{keys}");
    assert!(lines[2].starts_with("line 5, column 10: system: invalid type"), "{keys}");
    let values = error("[limits]\nmax_speed_mps = -1\n[log]\nkeep_gb = 0\n");
    assert_eq!(values.lines().count(), 2, "{values}");
    assert!(values.contains("limits.max_speed_mps = -1") && values.contains("log.keep_gb"));
}

fn config() -> impl Strategy<Value = JetsonConfig> {
    let text = "[ -~]{1,32}";
    let fingerprint = any::<Vec<u8>>().prop_map(|bytes| Fingerprint::of(&bytes));
    let server =
        ("[a-z0-9.]{1,20}", any::<u16>(), prop::option::of(fingerprint), prop::option::of(text));
    let server = server.prop_map(|(host, port, fingerprint, keys)| ServerConfig {
        address: format!("{host}:{port}"),
        fingerprint,
        keys: keys.map(PathBuf::from),
    });
    let mavlink = ("udp(in|out)", any::<u16>());
    let mavlink = mavlink.prop_map(|(kind, port)| format!("{kind}:127.0.0.1:{port}"));
    let vehicle = (prop::option::of(text), prop::option::of(mavlink))
        .prop_map(|(name, mavlink)| VehicleConfig { name, mavlink, ..VehicleConfig::default() });
    let limit = || prop::option::of(5.0..30.0);
    let limits = (limit(), limit(), limit(), limit()).prop_map(|(v, a, tilt, z)| LimitsConfig {
        max_speed_mps: v,
        max_acceleration_mps2: a,
        max_tilt_deg: tilt,
        max_altitude_m: z,
    });
    let plugin = (prop::option::of(text), prop::option::of(64_u64..99_999), any::<bool>());
    let plugin = plugin.prop_map(|(path, memory_mb, network)| PluginConfig {
        path: path.map(PathBuf::from),
        memory_mb,
        network,
        write: vec!["data".into()],
        ..PluginConfig::default()
    });
    let images = prop::option::of(Just(LoggedImages::Full));
    let log = (images, prop::option::of(1.0..99.0), prop::option::of(1.0..99.0))
        .prop_map(|(images, keep_gb, keep_days)| LogConfig { images, keep_gb, keep_days });
    (prop::option::of(server), vehicle, limits, plugin, log).prop_map(
        |(server, vehicle, limits, plugin, log)| JetsonConfig {
            server,
            vehicle,
            limits,
            plugin,
            log,
        },
    )
}

/// Returns all keys of a file as `(section, key)`.
fn keys(text: &str) -> Vec<(String, String)> {
    let table: toml::Table = text.parse().unwrap();
    let inner = |(section, value): (&String, &toml::Value)| {
        let keys = value.as_table().into_iter().flat_map(toml::Table::keys);
        keys.map(|key| (section.clone(), key.clone())).collect::<Vec<_>>()
    };
    table.iter().flat_map(inner).collect()
}

proptest! {
    #[test]
    fn written_text_is_read_back(config in config()) {
        let text = config.to_toml().unwrap();
        prop_assert_eq!(JetsonConfig::parse(&text).unwrap(), config);
    }

    /// Every key with any one letter replaced is rejected, and the error names it.
    #[test]
    fn suggests_the_right_key_for_a_misspelt_one(
        config in config(),
        which in any::<prop::sample::Index>(),
        at in any::<prop::sample::Index>(),
    ) {
        let text = config.to_toml().unwrap();
        let keys = keys(&text);
        prop_assume!(!keys.is_empty());
        let (section, key) = which.get(&keys);
        let at = at.index(key.len());
        let misspelt = format!("{}Z{}", &key[..at], &key[at + 1..]);
        let (before, after) = text.split_once(&format!("[{section}]\n")).unwrap();
        let after = format!("\n{after}").replacen(&format!("\n{key} = "), &format!("\n{misspelt} = "), 1);
        let error = JetsonConfig::parse(&format!("{before}[{section}]\n{after}")).unwrap_err();
        let expected = format!("'{misspelt}'; did you mean '{key}'");
        prop_assert!(error.to_string().contains(&expected), "{}", error);
    }

    #[test]
    fn no_text_panics(text in "\\PC*|(\\[(server|limits|[a-z]*)\\]\n([a-z_]+ = [0-9\"a-z.]*\n)*)*") {
        if let Ok(config) = JetsonConfig::parse(&text) {
            prop_assert_eq!(JetsonConfig::parse(&config.to_toml().unwrap()).unwrap(), config);
        }
    }
}

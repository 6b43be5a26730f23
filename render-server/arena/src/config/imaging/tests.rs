use super::*;

fn parsed(text: &str) -> Result<ImagingConfig, String> {
    let config: ImagingConfig = toml::from_str(text).map_err(|error| error.to_string())?;
    config.check(|name| format!("imaging.{name}")).map_err(|error| error.to_string())?;
    Ok(config)
}

#[test]
fn every_named_sensor_is_valid_and_matches_published_values() {
    for (name, sensor) in SENSORS {
        let config = parsed(&format!("sensor = \"{name}\"")).unwrap();
        assert_eq!(config.light_sensor(), Some(*sensor));
        assert_eq!(config.describe(), *name);
        assert!(
            (8..=16).contains(&sensor.bits) && sensor.full_well_e > 100.0 * sensor.read_noise_e
        );
    }
    for (name, depth) in DEPTHS {
        let config = parsed(&format!("depth = {{ model = \"{name}\" }}")).unwrap();
        assert_eq!((config.depth_sensor(), config.light_sensor()), (Some(*depth), None));
        assert_eq!(config.describe(), format!("depth {name}"));
    }
    // The data sheet's exposure of the IMX219: 706 cd/m^2 at F2.8 for 1/120 s give a fifth of full scale.
    let config = parsed("sensor = \"imx219\"\nilluminance_lx = 2217.9\nf_number = 2.8").unwrap();
    let sensor = config.light_sensor().unwrap();
    // The data sheet's lens loses no light.
    let share = sensor.electrons_per_s() / 0.9 / 120.0 / sensor.full_well_e;
    assert!((share - 205.0 / 1023.0).abs() < 0.01, "{share}");
    assert!((sensor.readout_s - 0.0233).abs() < 1e-4);
    assert_eq!(
        [sensor.binned(3280), sensor.binned(640), sensor.binned(320), sensor.binned(9999)],
        [1, 5, 10, 1]
    );
    // The Azure Kinect's standard deviation at the end of its range is its published bound.
    let Some(DepthSensor::TimeOfFlight(tof)) =
        parsed("depth = { model = \"azure-kinect\" }").unwrap().depth_sensor()
    else {
        panic!("a time-of-flight camera")
    };
    let signal_e = tof.signal_e_1m / 3.86f64.powi(2);
    let per_rad_m = presets::LIGHT_MPS / (4.0 * core::f64::consts::PI * tof.modulation_hz);
    let sigma_m = per_rad_m * (2.0 * signal_e).sqrt() / (tof.contrast * signal_e);
    assert!((sigma_m - 0.017).abs() < 5e-4, "{sigma_m} m");
}

#[test]
fn given_values_override_the_preset() {
    let config = parsed(
        "sensor = \"ov9281\"\nexposure_ms = 4\ngain = 2\nreadout_ms = 10\nfilter = \"bayer\"\nbinning = 3\nnoise = false\n\
         depth = { model = \"tofcam-635\", modulation_mhz = 60, max_m = 2.0 }",
    )
    .unwrap();
    let sensor = config.light_sensor().unwrap();
    assert_eq!((sensor.fixed_s, sensor.fixed_gain, sensor.readout_s), (Some(0.004), 2.0, 0.01));
    assert_eq!((sensor.filter, sensor.noise, sensor.binned(320)), (FilterKind::Bayer, false, 3));
    let Some(DepthSensor::TimeOfFlight(tof)) = config.depth_sensor() else { panic!("{config:?}") };
    assert!((tof.unambiguous_m - 2.498_27).abs() < 1e-4 && tof.most_m == 2.0);
    // Writing and reading keeps the values.
    assert_eq!(parsed(&toml::to_string(&config).unwrap()).unwrap(), config);
    assert_eq!(parsed("").unwrap(), ImagingConfig::default());
    assert_eq!(ImagingConfig::default().describe(), "perfect");
}

#[test]
fn errors_name_the_key_and_advice() {
    let refused = |text: &str, expected: &str| {
        let error = parsed(text).unwrap_err();
        assert!(error.contains(expected), "'{error}' lacks '{expected}'");
    };
    refused(
        "sensor = \"imx999\"",
        "imaging.sensor = \"imx999\": unknown; give one of imx219, imx477",
    );
    refused("lens = 3", "unknown field `lens`");
    refused("vignette = 0.3", "imaging.vignette = given: needs a sensor; add sensor, one of");
    refused("sensor = \"imx219\"\ngain = 2", "give exposure_ms, or max_gain instead");
    refused(
        "sensor = \"imx219\"\nreadout_ms = -1",
        "imaging.readout_ms = -1: give a number from 0",
    );
    refused("sensor = \"imx219\"\nilluminance_lx = nan", "imaging.illuminance_lx = NaN");
    refused("sensor = \"imx219\"\nfilter = \"foveon\"", "unknown variant `foveon`");
    refused(
        "depth = { model = \"lidar\" }",
        "imaging.depth.model = \"lidar\": unknown; give one of d435",
    );
    refused(
        "depth = { model = \"d435\", multipath = true }",
        "d435 is a stereo pair and does not have this key",
    );
    refused("depth = { model = \"azure-kinect\", baseline_mm = 50 }", "a time-of-flight camera");
    refused("depth = { model = \"d435\", max_m = 0 }", "imaging.depth.max_m = 0");
    refused("depth = {}", "missing field `model`");
}

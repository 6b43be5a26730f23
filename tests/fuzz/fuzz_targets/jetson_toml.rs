//! jetson.toml: an error message, or settings that are unchanged after writing and reading.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_runtime::config::JetsonConfig;

fuzz_target!(|text: &str| match JetsonConfig::parse(text) {
    Ok(config) => {
        assert_eq!(JetsonConfig::parse(&config.to_toml().unwrap()).unwrap(), config);
    }
    Err(error) => assert!(!error.to_string().is_empty()),
});

//! A jetson.toml: one sentence, or settings that are written and read again as they are.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_runtime::config::JetsonConfig;

fuzz_target!(|text: &str| match JetsonConfig::parse(text) {
    Ok(config) => {
        assert_eq!(JetsonConfig::parse(&config.to_toml().unwrap()).unwrap(), config);
    }
    Err(error) => assert!(!error.to_string().is_empty()),
});

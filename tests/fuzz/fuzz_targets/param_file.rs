//! Parameter files of an airframe.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_runtime::airframe::{FenceCylinder, Version, compare, parse_params};

fuzz_target!(|text: &str| {
    let Ok(params) = parse_params(text) else { return };
    for version in Version::ALL {
        let same =
            compare(version, &params, FenceCylinder::default(), |name| params.get(name).copied());
        assert!(same.is_empty(), "{same:?}");
        let none = compare(version, &params, FenceCylinder::default(), |_| None);
        assert_eq!(none.len(), params.len());
    }
});

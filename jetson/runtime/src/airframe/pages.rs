//! Tests that pages, drawings, parameter files and firmware agree with the table `hardware/vehicle.toml`.
//!
//! ```text
//! vehicle.toml ──▶ tables of the pages, character by character (VIZFLYT_PAGES=write writes them)
//!              ──▶ ports and parameters in sentences of the pages
//!              ──▶ wires and resistors of the drawings, from pin to pad
//!              ──▶ the values of every parameter file; the pins that the firmware drives
//! ```
//!
//! Each check returns the differences, so that a test can change the table and verify that the change is detected.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::tuning::UNTUNED;
use super::{Version, param_spec, parse_params, shipped};
use crate::link::same;

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    port: Vec<Port>,
    wire: Vec<Wire>,
    resistor: Vec<Resistor>,
    supply: Vec<Supply>,
    tuning: Vec<Tuning>,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Port {
    name: String,
    device: String,
    serial: u8,
    protocol: u32,
    baud: u32,
    rtscts: u32,
    from: String,
    to: String,
    wires: u8,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Wire {
    pin: u8,
    signal: String,
    esp32c3: String,
    esp32c3_text: Option<String>,
    esp32c3_chip: String,
    esp8266: String,
    esp8266_text: Option<String>,
    esp8266_chip: Option<String>,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Resistor {
    board: String,
    pin: String,
    pad: String,
    ohm: String,
    to: String,
    why: String,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Supply {
    board: String,
    peak_ma: u32,
    peak_text: String,
    regulator: String,
    capacitor: String,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Tuning {
    name: String,
    value: f64,
    default: f64,
    why: String,
}

impl Port {
    /// Returns the parameters of the port, with names that every version has.
    fn params(&self) -> [(String, f64); 3] {
        let Self { serial, protocol, baud, rtscts, .. } = self;
        [
            (format!("SERIAL{serial}_PROTOCOL"), f64::from(*protocol)),
            (format!("SERIAL{serial}_BAUD"), f64::from(*baud)),
            (format!("BRD_SER{serial}_RTSCTS"), f64::from(*rtscts)),
        ]
    }
}

impl Table {
    fn read() -> Self {
        toml::from_str(&text("hardware/vehicle.toml")).expect("hardware/vehicle.toml is valid")
    }

    /// Returns the port of a device.
    fn port_of(&self, device: &str) -> &Port {
        self.port.iter().find(|port| port.device == device).expect("it has a port")
    }

    /// Returns the tables of the pages, which are between `<!-- vehicle.toml: NAME -->` and `<!-- end -->`.
    fn blocks(&self) -> BTreeMap<&'static str, String> {
        let mut ports = "| from | to | wires | parameters |\n|---|---|---|---|\n".to_owned();
        for port in &self.port {
            let params = port.params().map(|(name, value)| format!("`{name}` {value}")).join(", ");
            let Port { name, from, to, wires, .. } = port;
            writeln!(ports, "| {name}: {from} | {to} | {wires} | {params} |").unwrap();
        }
        let mut wires = format!(
            "| {} (JST-GH) | signal | XIAO ESP32C3 | other ESP32-C3 | ESP8266 (ESP-12F) |\n|---|---|---|---|---|\n",
            self.port_of("bridge").name
        );
        for wire in &self.wire {
            let xiao = wire.esp32c3_text.as_ref().unwrap_or(&wire.esp32c3);
            let esp8266 = match (&wire.esp8266_text, &wire.esp8266_chip) {
                (Some(text), _) => text.clone(),
                (None, Some(chip)) if *chip != wire.esp8266.replace("IO", "GPIO") => {
                    format!("{chip} ({})", wire.esp8266)
                }
                (None, chip) => chip.clone().unwrap_or_else(|| wire.esp8266.clone()),
            };
            let Wire { pin, signal, esp32c3_chip, .. } = wire;
            writeln!(wires, "| {pin} | {signal} | {xiao} | {esp32c3_chip} | {esp8266} |").unwrap();
        }
        let mut resistors =
            "| board | pin | resistor | to | because |\n|---|---|---|---|---|\n".to_owned();
        for Resistor { board, pin, ohm, to, why, .. } in &self.resistor {
            writeln!(resistors, "| {board} | {pin} | {ohm} | {to} | {why} |").unwrap();
        }
        let mut supply =
            "| bridge | draws at most | when | regulator | capacitors |\n|---|---|---|---|---|\n"
                .to_owned();
        for Supply { board, peak_ma, peak_text, regulator, capacitor } in &self.supply {
            writeln!(
                supply,
                "| {board} | {peak_ma} mA | {peak_text} | {regulator} | {capacitor} |"
            )
            .unwrap();
        }
        let mut tuning =
            "| 4.7, 4.8 | | 4.5, 4.6 | | ArduCopter's own | because |\n|---|---|---|---|---|---|\n"
                .to_owned();
        for Tuning { name, value, default, why } in &self.tuning {
            let spec = param_spec(Version::V48, name).expect("a known name");
            let (old, old_value) =
                (spec.name_in(Version::V46), spec.value_in(Version::V46, *value));
            let old = if old == name { "the same".to_owned() } else { format!("`{old}`") };
            // Remove rounding errors of the product.
            let old_value = (old_value * 1e6).round() / 1e6;
            writeln!(tuning, "| `{name}` | {value} | {old} | {old_value} | {default} | {why} |")
                .unwrap();
        }
        BTreeMap::from([
            ("ports", ports),
            ("wires", wires),
            ("resistors", resistors),
            ("supply", supply),
            ("tuning", tuning),
        ])
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn text(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Pages, and the tables that they must contain.
const PAGES: &[(&str, &[&str])] = &[
    ("hardware/bridge/README.md", &["wires", "resistors", "supply"]),
    ("hardware/airframe/wiring.md", &["ports", "supply"]),
    ("hardware/airframe/first-hover.md", &["tuning"]),
    ("hardware/airframe/README.md", &[]),
    ("hardware/airframe/checklists.md", &[]),
    ("hardware/airframe/parts.md", &[]),
    ("docs/guides/flash-bridge.md", &[]),
    ("docs/guides/jetson.md", &[]),
];

/// Drawings, and the board of each.
const DRAWINGS: &[(&str, &[&str])] = &[
    ("hardware/bridge/wiring-esp32c3.svg", &["ESP32-C3"]),
    ("hardware/bridge/wiring-esp8266.svg", &["ESP8266"]),
];

const END: &str = "<!-- end -->";

/// Returns a page with corrected tables, and the names of its tables.
fn with_blocks(page: &str, blocks: &BTreeMap<&str, String>) -> (String, Vec<String>) {
    let (mut out, mut rest, mut names) = (String::new(), page, Vec::new());
    while let Some((before, after)) = rest.split_once("<!-- vehicle.toml: ") {
        let (name, after) = after.split_once(" -->").expect("a table's name ends");
        let (_, after) = after.split_once(END).expect("a table ends");
        let block = blocks.get(name).unwrap_or_else(|| panic!("there is no table {name:?}"));
        write!(out, "{before}<!-- vehicle.toml: {name} -->\n{block}{END}").unwrap();
        names.push(name.to_owned());
        rest = after;
    }
    (out + rest, names)
}

/// Returns pages with tables that differ from the table.
fn wrong_blocks(table: &Table) -> Vec<String> {
    let mut found = Vec::new();
    for (path, expected) in PAGES {
        let page = text(path);
        let (right, names) = with_blocks(&page, &table.blocks());
        if names != *expected {
            found.push(format!("{path} has the tables {names:?}, not {expected:?}"));
        }
        for (line, (has, should)) in page.lines().zip(right.lines()).enumerate() {
            if has != should {
                found.push(format!("{path}:{}: {has:?}, should be {should:?}", line + 1));
            }
        }
        if page.lines().count() != right.lines().count() {
            found.push(format!("{path}: a table has other rows"));
        }
    }
    found
}

/// Returns the names and numbers of a line.
fn words(line: &str) -> Vec<&str> {
    line.split(|c: char| !(c.is_ascii_alphanumeric() || matches!(c, '_' | '.')))
        .map(|word| word.trim_matches('.'))
        .filter(|word| !word.is_empty())
        .collect()
}

/// Returns sentences in pages and drawings that give another port for a device, or another value for a parameter of the
/// table.
fn wrong_sentences(table: &Table) -> Vec<String> {
    let mut values: BTreeMap<String, f64> = table.port.iter().flat_map(Port::params).collect();
    for Tuning { name, value, .. } in &table.tuning {
        for version in Version::ALL {
            let spec = param_spec(Version::V48, name).expect("a known name");
            values.insert(spec.name_in(version).to_owned(), spec.value_in(version, *value));
        }
    }
    let mut found = Vec::new();
    for path in PAGES.iter().chain(DRAWINGS).map(|(path, ..)| path) {
        let about = table.port.iter().find(|port| path.contains(&port.device.to_lowercase()));
        // A page is about one device, even if a line does not mention it; a drawing also shows the plug of the other
        // device.
        let is_page = PAGES.iter().any(|(page, _)| page == path);
        for (number, line) in text(path).lines().enumerate() {
            let at = format!("{path}:{}", number + 1);
            let lower = line.to_lowercase();
            let speaks_of = |port: &Port| lower.contains(&port.device.to_lowercase());
            let words = words(line);
            for port in &table.port {
                let is_anothers = !speaks_of(port)
                    && table.port.iter().any(|other| {
                        other.name != port.name
                            && (speaks_of(other)
                                || is_page && about.is_some_and(|about| about.name == other.name))
                    });
                if words.contains(&port.name.as_str()) && is_anothers {
                    found.push(format!("{at}: {} is the {}'s", port.name, port.device));
                }
                for (name, _) in port.params() {
                    let foreign = about.is_some_and(|about| about.name != port.name);
                    if foreign && words.contains(&name.as_str()) {
                        found.push(format!("{at}: {name} is the {}'s", port.device));
                    }
                }
            }
            for pair in words.windows(2) {
                let (right, value) = (values.get(pair[0]), pair[1].parse::<f64>());
                let (Some(right), Ok(value)) = (right, value) else { continue };
                if !same(*right, value) {
                    found.push(format!("{at}: {} is {right}, not {value}", pair[0]));
                }
            }
        }
    }
    // Each guide must contain all parameters of its port.
    for (path, device) in
        [("docs/guides/flash-bridge.md", "bridge"), ("docs/guides/jetson.md", "Jetson")]
    {
        let page = text(path);
        for (name, _) in table.port_of(device).params() {
            if !page.contains(&name) {
                found.push(format!("{path} does not say {name}"));
            }
        }
    }
    found
}

/// Returns values of the parameter files that differ from the table, and tuning parameters that only one of them has.
fn wrong_params(table: &Table) -> Vec<String> {
    let mut found = Vec::new();
    for version in Version::ALL {
        let params = parse_params(shipped(version)).expect("a valid file");
        let mut check = |name: &str, right: f64| {
            if !params.get(name).is_some_and(|value| same(*value, right)) {
                found.push(format!("{version:?}: {name} is {:?}, not {right}", params.get(name)));
            }
        };
        for (name, right) in table.port.iter().flat_map(Port::params) {
            check(&name, right);
        }
        for Tuning { name, value, .. } in &table.tuning {
            let spec = param_spec(Version::V48, name).expect("a known name");
            check(spec.name_in(version), spec.value_in(version, *value));
        }
    }
    for (name, default) in UNTUNED {
        let row = table.tuning.iter().find(|row| row.name == *name);
        if *name != "VISO_DELAY_MS" && !row.is_some_and(|row| same(row.default, *default)) {
            found.push(format!("{name}: the table has another default than {default}"));
        }
    }
    found
}

/// Text of a drawing, and its position.
struct Label<'a> {
    x: f64,
    y: f64,
    text: &'a str,
}

fn attribute<'a>(element: &'a str, name: &str) -> Option<&'a str> {
    element.split_once(&format!(" {name}=\"")).and_then(|(_, rest)| rest.split('"').next())
}

fn labels(drawing: &str) -> Vec<Label<'_>> {
    let label = |element: &'_ str| -> Option<(f64, f64)> {
        Some((attribute(element, "x")?.parse().ok()?, attribute(element, "y")?.parse().ok()?))
    };
    drawing
        .split("<text")
        .skip(1)
        .filter_map(|element| {
            let (head, rest) = element.split_once('>')?;
            let (x, y) = label(head)?;
            Some(Label { x, y, text: rest.split('<').next()? })
        })
        .collect()
}

/// Returns the start and the end of the path with this id.
fn ends_of(drawing: &str, id: &str) -> Option<[(f64, f64); 2]> {
    let (_, rest) = drawing.split_once(&format!("id=\"{id}\""))?;
    let numbers: Vec<f64> = attribute(rest, "d")?
        .split(|c: char| !(c.is_ascii_digit() || matches!(c, '.' | '-')))
        .filter_map(|number| number.parse().ok())
        .collect();
    let [x, y, .., end_x, end_y] = numbers[..] else { return None };
    Some([(x, y), (end_x, end_y)])
}

/// Distance of a text's baseline below the middle of the labelled object. [px]
const BASELINE: f64 = 5.0;
/// Maximum distance of a wire's end from the label of its pad; rows are 38 apart. [px]
const NEAR: (f64, f64) = (50.0, 10.0);
/// Distance of the plug's numbers to the left of its wires. [px]
const NUMBER_LEFT: f64 = 98.0;
/// Maximum distance of a resistor's value from its middle. [px]
const LABEL_NEAR: f64 = 70.0;

/// Returns wires and resistors of the drawings that do not connect the table's pin with its pad.
fn wrong_drawings(table: &Table) -> Vec<String> {
    let mut found = Vec::new();
    for (path, boards) in DRAWINGS {
        let board = boards[0];
        let drawing = text(path);
        let labels = labels(&drawing);
        let meets = |(x, y): (f64, f64), text: &str| {
            labels.iter().any(|label| {
                label.text == text
                    && (label.x - x).abs() < NEAR.0
                    && (label.y - BASELINE - y).abs() < NEAR.1
            })
        };
        let port = &table.port_of("bridge").name;
        if !labels.iter().any(|label| label.text == port && label.y > 300.0) {
            found.push(format!("{path}: the plug is not labelled {port}"));
        }
        for wire in &table.wire {
            let (pad, chip) = match board {
                "ESP8266" => (&wire.esp8266, wire.esp8266_chip.as_ref()),
                _ => (&wire.esp32c3, Some(&wire.esp32c3_chip)),
            };
            let pin = wire.pin;
            let Some([(x, y), end]) = ends_of(&drawing, &format!("wire-{pin}")) else {
                found.push(format!("{path} has no wire-{pin}"));
                continue;
            };
            if !meets((x - NUMBER_LEFT, y), &pin.to_string()) {
                found.push(format!("{path}: wire-{pin} does not begin at pin {pin}"));
            }
            let end = ends_of(&drawing, &format!("wire-{pin}-end")).map_or(end, |[_, end]| end);
            if !meets(end, pad) {
                found.push(format!("{path}: wire-{pin} does not end at {pad}"));
            }
            let named =
                |label: &Label| chip.is_some_and(|chip| words(label.text).contains(&chip.as_str()));
            let has_chip_pin = chip.is_some_and(|chip| chip.starts_with("GPIO"));
            if has_chip_pin && !labels.iter().any(named) {
                found.push(format!("{path}: {} stands nowhere", chip.unwrap()));
            }
        }
        for resistor in table.resistor.iter().filter(|resistor| resistor.board == board) {
            let id = format!("pull-{}", resistor.pad);
            let Some([start, end]) = ends_of(&drawing, &id) else {
                found.push(format!("{path} has no {id}"));
                continue;
            };
            // Either at the pad itself, or on the wire to it: at the height of that wire.
            let on_row = labels.iter().any(|label| {
                label.text == resistor.pad && (label.y - BASELINE - start.1).abs() < NEAR.1
            });
            if !on_row {
                found.push(format!("{path}: {id} does not begin at {}", resistor.pad));
            }
            let middle = (f64::midpoint(start.0, end.0), f64::midpoint(start.1, end.1));
            let near = |label: &&Label| (label.x - middle.0).hypot(label.y - middle.1) < LABEL_NEAR;
            let ohm = resistor.ohm.replace('Ω', "&#937;");
            if !labels.iter().filter(near).any(|label| label.text == ohm) {
                found.push(format!("{path}: {id} is not labelled {}", resistor.ohm));
            }
            let rail = drawing
                .split(&format!("id=\"{id}\""))
                .nth(1)
                .and_then(|rest| attribute(rest, "data-to"));
            if rail != Some(resistor.to.as_str()) {
                found.push(format!("{path}: {id} leads to {rail:?}, not {}", resistor.to));
            }
        }
    }
    found
}

/// Returns pins that the ESP32-C3's firmware uses differently.
fn wrong_firmware(table: &Table) -> Vec<String> {
    let source = text("firmware-esp/bridge/src/settings.rs");
    let usual = source.lines().find(|line| line.contains("const USUAL")).unwrap_or_default();
    let pins = ["rx", "tx", "rts", "cts"];
    let mut found = Vec::new();
    for (wire, pin) in table.wire.iter().skip(1).zip(pins) {
        let expected = format!("{pin}: {}", wire.esp32c3_chip.trim_start_matches("GPIO"));
        if !usual.split(['{', '}', ',']).any(|part| part.trim() == expected) {
            found.push(format!("the bridge's usual pins have no {expected}"));
        }
    }
    found
}

#[test]
fn pages_have_the_tables_rows() {
    let table = Table::read();
    if std::env::var("VIZFLYT_PAGES").is_ok_and(|value| value == "write") {
        for (path, _) in PAGES {
            let (right, _) = with_blocks(&text(path), &table.blocks());
            std::fs::write(root().join(path), right).expect("the page can be written");
        }
    }
    assert_eq!(wrong_blocks(&table), Vec::<String>::new(), "VIZFLYT_PAGES=write writes the tables");
}

#[test]
fn pages_name_the_right_ports_and_values() {
    assert_eq!(wrong_sentences(&Table::read()), Vec::<String>::new());
}

#[test]
fn parameter_files_have_the_tables_values() {
    assert_eq!(wrong_params(&Table::read()), Vec::<String>::new());
}

#[test]
fn drawings_show_the_tables_wires() {
    assert_eq!(wrong_drawings(&Table::read()), Vec::<String>::new());
}

#[test]
fn firmware_drives_the_tables_pins() {
    assert_eq!(wrong_firmware(&Table::read()), Vec::<String>::new());
}

/// Changes one value in the table, and expects every dependent check to report it.
#[test]
fn every_change_of_the_table_is_detected() {
    type Check = fn(&Table) -> Vec<String>;
    let check = |change: fn(&mut Table), checks: &[(&str, Check)]| {
        let mut table = Table::read();
        change(&mut table);
        for (name, check) in checks {
            assert!(!check(&table).is_empty(), "{name} does not detect the change");
        }
    };
    let blocks: (&str, Check) = ("tables", wrong_blocks);
    let sentences: (&str, Check) = ("sentences", wrong_sentences);
    let params: (&str, Check) = ("parameter files", wrong_params);
    let drawings: (&str, Check) = ("drawings", wrong_drawings);
    let firmware: (&str, Check) = ("firmware", wrong_firmware);
    let swap_ports = |table: &mut Table| {
        let (first, second) = table.port.split_at_mut(1);
        std::mem::swap(&mut first[0].name, &mut second[0].name);
        std::mem::swap(&mut first[0].serial, &mut second[0].serial);
    };
    check(swap_ports, &[blocks, sentences, drawings]);
    check(|table| table.port[0].rtscts = 1, &[blocks, sentences, params]);
    check(|table| table.port[1].baud = 115, &[blocks, sentences, params]);
    let swap_pins = |table: &mut Table| {
        let (first, second) = table.wire.split_at_mut(2);
        std::mem::swap(&mut first[1].esp32c3, &mut second[0].esp32c3);
        std::mem::swap(&mut first[1].esp32c3_chip, &mut second[0].esp32c3_chip);
    };
    check(swap_pins, &[blocks, drawings, firmware]);
    check(|table| table.wire[3].esp8266 = "IO12".to_owned(), &[blocks, drawings]);
    check(|table| table.resistor[0].ohm = "10 kΩ".to_owned(), &[blocks, drawings]);
    check(|table| table.resistor[5].to = "3.3 V".to_owned(), &[blocks, drawings]);
    check(|table| table.supply[1].peak_ma = 300, &[blocks]);
    check(|table| table.tuning[10].value = 0.135, &[blocks, params]);
    check(|table| table.tuning[2].default = 0.0, &[blocks, params]);
}

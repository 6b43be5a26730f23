//! Generates `page/messages.d.ts`, against which the page's scripts are checked, and tests that it is up to date. The
//! TypeScript type of each message is derived from a full and a sparse serialized example.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use serde_json::Value;

use super::examples;

/// Returns the declarations of all messages, in TypeScript.
fn declarations() -> String {
    let mut text = HEADER.to_owned();
    for (name, examples) in examples::all() {
        let fields = type_of(&examples.iter().collect::<Vec<_>>(), 0);
        let _ = writeln!(text, "export type {name} = {fields};\n");
    }
    text + ALIASES
}

/// Returns the common type of these values.
fn type_of(values: &[&Value], indent: usize) -> String {
    let mut types = BTreeSet::new();
    let (mut arrays, mut objects) = (Vec::new(), Vec::new());
    for value in values {
        match value {
            Value::Null => _ = types.insert("null".to_owned()),
            Value::Bool(_) => _ = types.insert("boolean".to_owned()),
            Value::Number(_) => _ = types.insert("number".to_owned()),
            Value::String(_) => _ = types.insert("string".to_owned()),
            Value::Array(items) => arrays.push(items),
            Value::Object(fields) => objects.push(fields),
        }
    }
    if !arrays.is_empty() {
        types.insert(array_type(&arrays, indent));
    }
    for variant in variants(&objects) {
        types.insert(object_type(&variant, indent));
    }
    // `null` comes last.
    let null = types.remove("null");
    types.into_iter().chain(null.then(|| "null".to_owned())).collect::<Vec<_>>().join(" | ")
}

/// Returns a tuple if all arrays have the same small length, otherwise a list.
fn array_type(arrays: &[&Vec<Value>], indent: usize) -> String {
    let items: Vec<_> = arrays.iter().copied().flatten().collect();
    let length = arrays[0].len();
    let is_tuple = (2..=4).contains(&length)
        && arrays.iter().all(|array| array.len() == length)
        && items.iter().all(|item| item.is_number());
    if is_tuple {
        return format!("[{}]", vec!["number"; length].join(", "));
    }
    assert!(!items.is_empty(), "a list that is empty in every example has no type");
    let item = type_of(&items, indent);
    if item.contains(" | ") && !item.ends_with('}') { format!("({item})[]") } else { item + "[]" }
}

/// Groups objects by variant of an enumeration: variants have no key in common.
fn variants<'a>(objects: &[&'a Fields]) -> Vec<Vec<&'a Fields>> {
    let mut variants: Vec<Vec<&Fields>> = Vec::new();
    for &object in objects {
        let is_like = |variant: &&mut Vec<&Fields>| {
            variant.iter().any(|other| object.keys().any(|key| other.contains_key(key)))
        };
        match variants.iter_mut().find(is_like) {
            Some(variant) => variant.push(object),
            None => variants.push(vec![object]),
        }
    }
    variants
}

/// Returns the type of objects with these fields. A field that is missing in some is optional.
fn object_type(objects: &[&Fields], indent: usize) -> String {
    let mut fields: BTreeMap<&str, Vec<&Value>> = BTreeMap::new();
    for object in objects {
        for (key, value) in *object {
            fields.entry(key).or_default().push(value);
        }
    }
    let lines: Vec<_> = fields
        .iter()
        .map(|(key, values)| {
            let optional = if values.len() < objects.len() { "?" } else { "" };
            // Tag of the message.
            let literal = values[0].as_str().filter(|_| *key == "type");
            let kind =
                literal.map_or_else(|| type_of(values, indent + 2), |word| format!("\"{word}\""));
            format!("{key}{optional}: {kind}")
        })
        .collect();
    let line = format!("{{ {} }}", lines.join("; "));
    if line.len() < 100 && !line.contains('\n') && indent > 0 {
        return line;
    }
    let pad = " ".repeat(indent);
    format!("{{\n{pad}  {};\n{pad}}}", lines.join(&format!(";\n{pad}  ")))
}

/// Variable that makes the test write the file after a change: `VIZFLYT_WRITE_TYPES=1 cargo test -p vizflyt-server
/// typescript`.
const WRITE: &str = "VIZFLYT_WRITE_TYPES";

type Fields = serde_json::Map<String, Value>;

const HEADER: &str = "\
// Messages from the server to the page. A test generates this file from the server's types (messages/typescript.rs):
// VIZFLYT_WRITE_TYPES=1 cargo test -p vizflyt-server typescript

";

const ALIASES: &str = "\
export type Message = Arena | Cameras | Track | Events | State;
export type Camera = Cameras[\"cameras\"][number];
export type EventLine = Events[\"events\"][number];
";

#[test]
fn the_declarations_match_the_messages() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/web/page/messages.d.ts");
    let expected = declarations();
    if std::env::var_os(WRITE).is_some() {
        std::fs::write(&file, &expected).unwrap();
    }
    let found = std::fs::read_to_string(&file).unwrap();
    assert!(found == expected, "{} is not what {WRITE}=1 would write:\n{expected}", file.display());
}

#[test]
fn a_type_covers_all_its_examples() {
    fn check(examples: &[Value], expected: &str) {
        assert_eq!(type_of(&examples.iter().collect::<Vec<_>>(), 2), expected);
    }
    use serde_json::json;
    check(&[json!(1), json!(2.5)], "number");
    check(&[json!("a"), json!(null)], "string | null");
    check(&[json!([1, 2, 3]), json!([4, 5, 6])], "[number, number, number]");
    check(&[json!([1, 2, 3]), json!([])], "number[]");
    check(&[json!([[1, 2]])], "[number, number][]");
    check(&[json!(["a", null])], "(string | null)[]");
    check(&[json!({"a": 1, "b": true}), json!({"a": null})], "{ a: number | null; b?: boolean }");
    check(
        &[json!({"box": {"x": 1}}), json!({"ball": {"r": 1}})],
        "{ ball: { r: number } } | { box: { x: number } }",
    );
    check(
        &[json!("plain"), json!({"stage": {"index": 1}})],
        "string | { stage: { index: number } }",
    );
    check(&[json!({"type": "state", "n": 1})], "{ n: number; type: \"state\" }");
}

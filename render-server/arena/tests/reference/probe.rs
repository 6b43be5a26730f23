//! Probes the real reader of `arena.toml` with generated texts: accepted and required keys, defaults, and
//! ranges of numbers.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use syn::Expr;
use toml::{Table, Value};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::ConfigError;

use super::source::{Kind, Shape, Types};

/// One step down to a table: the key, whether it contains a list of such tables, and the variant of a tagged
/// table.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Step {
    pub(crate) key: String,
    pub(crate) list: bool,
    pub(crate) variant: Option<String>,
}

/// A table of the file: its path and its type.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    pub(crate) way: Vec<Step>,
    pub(crate) table: String,
}

impl Place {
    pub(crate) fn variant(&self) -> Option<&str> {
        self.way.last()?.variant.as_deref()
    }

    /// Returns the path in the form of error messages: `cameras.imaging`.
    pub(crate) fn name(&self) -> String {
        self.way.iter().map(|step| step.key.as_str()).collect::<Vec<_>>().join(".")
    }
}

/// Returns every table of the file, each variant separately, from the top down.
pub(crate) fn places(types: &Types) -> Vec<Place> {
    let mut places = vec![Place { way: Vec::new(), table: "ArenaConfig".to_owned() }];
    let mut next = 0;
    while let Some(place) = places.get(next).cloned() {
        next += 1;
        for key in types.keys(&place.table, place.variant()) {
            let Some((table, list)) = types.table_of(&key.kind) else { continue };
            let variants: Vec<Option<String>> = match &types.get(table).shape {
                Shape::Tagged { variants, .. } => {
                    variants.iter().map(|variant| Some(variant.name.clone())).collect()
                }
                _ => vec![None],
            };
            for variant in variants {
                let mut way = place.way.clone();
                way.push(Step { key: key.name.clone(), list, variant });
                places.push(Place { way, table: table.to_owned() });
            }
        }
    }
    places
}

/// Returns a file with only the required keys and those on the path to a table, which `change` may change.
pub(crate) fn least_file(types: &Types, place: &Place, change: &dyn Fn(&mut Table)) -> Table {
    along(types, "ArenaConfig", None, &place.way, change)
}

fn along(
    types: &Types,
    name: &str,
    variant: Option<&str>,
    way: &[Step],
    change: &dyn Fn(&mut Table),
) -> Table {
    let mut table = least_table(types, name, variant);
    let Some((step, rest)) = way.split_first() else {
        change(&mut table);
        return table;
    };
    let key = types.keys(name, variant).iter().find(|key| key.name == step.key).unwrap();
    let (inner, _) = types.table_of(&key.kind).unwrap();
    let inner = Value::Table(along(types, inner, step.variant.as_deref(), rest, change));
    table.insert(step.key.clone(), if step.list { Value::Array(vec![inner]) } else { inner });
    table
}

fn least_table(types: &Types, name: &str, variant: Option<&str>) -> Table {
    let mut table = Table::new();
    if let Shape::Tagged { tag, variants } = &types.get(name).shape {
        table.insert(tag.clone(), variant.unwrap_or(&variants[0].name).into());
    }
    for key in types.keys(name, variant).iter().filter(|key| key.required) {
        table.insert(key.name.clone(), least_value(types, &key.kind));
    }
    table
}

fn least_value(types: &Types, kind: &Kind) -> Value {
    match kind {
        Kind::Number => Value::Float(1.0),
        Kind::Integer => Value::Integer(1),
        Kind::Flag => Value::Boolean(true),
        Kind::Text => Value::String("x".to_owned()),
        Kind::Vector(count) | Kind::Numbers(count) => Value::Array(vec![Value::Float(1.0); *count]),
        Kind::List(_) => Value::Array(Vec::new()),
        Kind::Free => Value::Table(Table::new()),
        Kind::Named(name) => match &types.get(name).shape {
            Shape::Word(words) => Value::String(words.first().unwrap().name.clone()),
            Shape::As(other) => least_value(types, other),
            Shape::Table(_) | Shape::Tagged { .. } => Value::Table(least_table(types, name, None)),
        },
    }
}

/// Reads a file without validating its values.
pub(crate) fn read(file: Table) -> Result<ArenaConfig, String> {
    Value::Table(file).try_into().map_err(|error: toml::de::Error| error.message().to_owned())
}

/// Returns the keys that the reader lists in its error for an unknown key.
pub(crate) fn known_keys(types: &Types, place: &Place) -> BTreeSet<String> {
    let file = least_file(types, place, &|table| {
        table.insert("no_such_key".to_owned(), true.into());
    });
    let refusal = read(file).expect_err("a key that is not known is refused");
    let (_, expected) = refusal
        .split_once("`no_such_key`, expected ")
        .unwrap_or_else(|| panic!("{}: {refusal}", place.name()));
    expected.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Returns the default of each key of a table in TOML; `None` if there is none.
pub(crate) fn defaults(types: &Types, place: &Place) -> BTreeMap<String, Option<String>> {
    let config = read(least_file(types, place, &|_| ()))
        .unwrap_or_else(|error| panic!("{}: {error}", place.name()));
    // In Rust's debug form, which has the keys that serde leaves out of a file.
    let config = format!("{config:?}");
    let config = syn::parse_str::<Expr>(&config).unwrap_or_else(|e| panic!("{e}: {config}"));
    let mut inside = &config;
    for step in &place.way {
        inside = field(inside, &step.key);
        if let Expr::Array(list) = inside {
            inside = list.elems.first().unwrap();
        }
    }
    let keys = types.keys(&place.table, place.variant());
    let optional = keys.iter().filter(|key| !key.required);
    optional
        .map(|key| (key.name.clone(), written(types, &key.kind, field(inside, &key.name))))
        .collect()
}

/// Returns the value of a struct's field, without `Some`; a field may have a unit suffix that its key lacks.
fn field<'a>(of: &'a Expr, key: &str) -> &'a Expr {
    let Expr::Struct(of) = of else { panic!("not a struct with {key}") };
    let named = |name: &str| {
        of.fields.iter().find(|field| matches!(&field.member, syn::Member::Named(m) if m == name))
    };
    let found = named(key).or_else(|| named(&format!("{key}_m")));
    let value = &found.unwrap_or_else(|| panic!("no field {key}")).expr;
    match value {
        Expr::Call(call) if path_is(&call.func, "Some") => &call.args[0],
        value => value,
    }
}

fn path_is(expr: &Expr, name: &str) -> bool {
    matches!(expr, Expr::Path(path) if path.path.is_ident(name))
}

/// Returns a Rust value in TOML; `None` for `None`, an empty list, and tables.
fn written(types: &Types, kind: &Kind, value: &Expr) -> Option<String> {
    let list = |values: &syn::punctuated::Punctuated<Expr, syn::Token![,]>| {
        let values: Option<Vec<_>> =
            values.iter().map(|value| written(types, &Kind::Number, value)).collect();
        values.filter(|values| !values.is_empty()).map(|values| format!("[{}]", values.join(", ")))
    };
    match value {
        Expr::Lit(literal) => Some(match &literal.lit {
            syn::Lit::Float(number) => number.to_string(),
            syn::Lit::Int(number) => number.to_string(),
            syn::Lit::Bool(flag) => flag.value.to_string(),
            syn::Lit::Str(text) => format!("{:?}", text.value()),
            _ => panic!("a default that is not a number, flag or text"),
        }),
        Expr::Unary(negative) => Some(format!("-{}", written(types, kind, &negative.expr)?)),
        Expr::Array(array) => list(&array.elems),
        Expr::Call(vector) => list(&vector.args),
        Expr::Path(path) if !path_is(value, "None") => {
            let Kind::Named(name) = kind else { panic!("a word without a type") };
            let variant = path.path.get_ident().unwrap().to_string().to_lowercase();
            let Shape::Word(words) = &types.get(name).shape else { panic!("{name} is not a word") };
            let same = |word: &&super::source::Variant| {
                word.name.replace(['-', '_'], "").eq_ignore_ascii_case(&variant)
            };
            Some(format!("\"{}\"", words.iter().find(same).unwrap().name))
        }
        _ => None,
    }
}

/// Returns the ranges of numbers by [`Place::name`] and key, from the errors for NaN. Excludes keys whose range
/// depends on other values of the arena.
pub(crate) fn ranges(types: &Types, places: &[Place], example: &str) -> BTreeMap<String, String> {
    let example: Table = example.parse().unwrap();
    let mut larger = example.clone();
    let body_m = example["body_radius_m"].as_float().unwrap();
    larger.insert("body_radius_m".to_owned(), (body_m + 0.001).into());
    let width_m = &mut larger["stages"][0]["width_m"];
    *width_m = (width_m.as_float().unwrap() + 0.001).into();
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (place, file) in places.iter().flat_map(|place| [(place, &example), (place, &larger)]) {
        for (file, way) in spots(types, file, place) {
            for key in types.keys(&place.table, place.variant()) {
                let key_name = format!("{}.{}", place.name(), key.name);
                if let Some(range) = refused_range(&file, &way, &key.name, &key.kind) {
                    found.entry(key_name).or_default().insert(range);
                }
            }
        }
    }
    found.retain(|_, ranges| ranges.len() == 1);
    found.into_iter().map(|(key, ranges)| (key, ranges.into_iter().collect())).collect()
}

/// A step down to a value of a file.
#[derive(Clone, Debug)]
enum Part {
    Key(String),
    Index(usize),
}

/// Returns the positions of a table in a file; inserts one if the file has none.
fn spots(types: &Types, file: &Table, place: &Place) -> Vec<(Value, Vec<Part>)> {
    let mut spots = vec![(Value::Table(file.clone()), Vec::new())];
    let (mut name, mut variant) = ("ArenaConfig", None);
    for step in &place.way {
        let key = types.keys(name, variant).iter().find(|key| key.name == step.key).unwrap();
        name = types.table_of(&key.kind).unwrap().0;
        variant = step.variant.as_deref();
        let fits = |table: &Value| match &types.get(name).shape {
            Shape::Tagged { tag, .. } => table[tag.as_str()].as_str() == variant,
            _ => true,
        };
        let mut next = Vec::new();
        for (file, way) in &mut spots {
            let down = [way.clone(), vec![Part::Key(step.key.clone())]].concat();
            match at(file, way).0.get(&step.key) {
                Some(Value::Array(list)) => {
                    let fitting = (0..list.len()).filter(|&index| fits(&list[index]));
                    let down = |index| [down.clone(), vec![Part::Index(index)]].concat();
                    let found: Vec<_> = fitting.map(down).collect();
                    next.extend(found.into_iter().map(|way| (file.clone(), way)));
                }
                Some(table) if fits(table) => next.push((file.clone(), down)),
                _ => {}
            }
        }
        if next.is_empty() {
            let (mut file, mut way) = spots.swap_remove(0);
            let least = Value::Table(least_table(types, name, variant));
            let least = if step.list { Value::Array(vec![least]) } else { least };
            at(&mut file, &way).0.as_table_mut().unwrap().insert(step.key.clone(), least);
            way.push(Part::Key(step.key.clone()));
            way.extend(step.list.then_some(Part::Index(0)));
            next.push((file, way));
        }
        spots = next;
    }
    spots
}

/// Returns a value of a file, and its name in the form of error messages: `cameras[1].imaging`.
fn at<'a>(file: &'a mut Value, way: &[Part]) -> (&'a mut Value, String) {
    let mut name = String::new();
    let value = way.iter().fold(file, |value, part| match part {
        Part::Key(key) => {
            name.push_str(if name.is_empty() { "" } else { "." });
            name.push_str(key);
            &mut value[key.as_str()]
        }
        Part::Index(index) => {
            write!(name, "[{index}]").unwrap();
            &mut value[*index]
        }
    });
    (value, name)
}

/// Returns the range in the error for NaN, or for the largest integer.
fn refused_range(file: &Value, way: &[Part], key: &str, kind: &Kind) -> Option<String> {
    let wrong = match kind {
        Kind::Number => f64::NAN.into(),
        Kind::Integer => i32::MAX.into(),
        Kind::Vector(count) | Kind::Numbers(count) => vec![f64::NAN; *count].into(),
        _ => return None,
    };
    let mut file = file.clone();
    let (table, name) = at(&mut file, way);
    table.as_table_mut().unwrap().insert(key.to_owned(), wrong);
    let name = if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
    let errors = match ArenaConfig::parse(&toml::to_string(&file).unwrap()) {
        Err(ConfigError::Several(errors)) => errors,
        Err(error) => vec![error],
        Ok(_) => Vec::new(),
    };
    errors.iter().find_map(|error| {
        let ConfigError::Invalid { key, advice, .. } = error else { return None };
        let range = advice.strip_prefix("give a number from ").filter(|_| *key == name)?;
        let mut words = range.split(' ');
        match (words.next(), words.next(), words.next()) {
            (Some(low), Some("to"), Some(high)) => Some(format!("{low} to {high}")),
            _ => None,
        }
    })
}

//! Rust sources of the types that serde reads from an `arena.toml`: tables, keys, and descriptions.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use syn::{
    Attribute, Expr, ExprLit, Fields, GenericArgument, Item, Lit, LitStr, PathArguments, Token,
    Type,
};

/// Sources of the types, from the root of the repository: files, and folders with all files in them.
const SOURCES: &[&str] = &[
    "render-server/arena/src/config.rs",
    "render-server/arena/src/config",
    "render-server/arena/src/pose/config.rs",
    "protocol/core/src/messages/session.rs",
    "protocol/core/src/messages/kinds.rs",
    "protocol/core/src/geometry/lens_config.rs",
    "render-server/server/src/poses/settings",
];

/// Types with their own deserializer, and the type with the same keys; any other such type is a word.
const READ_AS: &[(&str, &str)] =
    &[("SceneConfig", "Table"), ("SetpointKinds", "Vec<SetpointKind>")];

/// Keys that the arena does not parse because the server reads them, and the server's type.
const READ_BY_SERVER: &[(&str, &str)] = &[("localization", "Vec<LocalizationConfig>")];

/// Kind of value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Kind {
    Number,
    Integer,
    Flag,
    Text,
    /// A vector with this number of axes.
    Vector(usize),
    /// This number of numbers, not a vector.
    Numbers(usize),
    List(Box<Kind>),
    /// A table with user-defined keys.
    Free,
    /// A type of [`Types`].
    Named(String),
}

/// One key of a table.
#[derive(Clone, Debug)]
pub(crate) struct Key {
    pub(crate) name: String,
    pub(crate) doc: String,
    /// Unit and frame of the number: `m, world`; empty if it has none.
    pub(crate) unit: String,
    pub(crate) kind: Kind,
    pub(crate) required: bool,
    /// Value without the key, if the sources define it.
    pub(crate) default: Option<String>,
}

/// A word that may be given, or a table with this word as its tag.
#[derive(Clone, Debug)]
pub(crate) struct Variant {
    pub(crate) name: String,
    pub(crate) doc: String,
    pub(crate) keys: Vec<Key>,
}

#[derive(Clone, Debug)]
pub(crate) enum Shape {
    Table(Vec<Key>),
    /// A table whose keys depend on the word at its key `tag`.
    Tagged {
        tag: String,
        variants: Vec<Variant>,
    },
    /// One of these words; empty for a word composed by a deserializer.
    Word(Vec<Variant>),
    /// Same as another type.
    As(Kind),
}

#[derive(Clone, Debug)]
pub(crate) struct Described {
    pub(crate) doc: String,
    pub(crate) shape: Shape,
    /// Name of the default variant of a word.
    default: Option<String>,
}

/// All types of the sources by name.
pub(crate) struct Types(BTreeMap<String, Described>);

impl Types {
    pub(crate) fn read() -> Self {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut types = Self(BTreeMap::new());
        let mut own_docs = BTreeMap::new();
        for path in SOURCES.iter().flat_map(|source| rust_files(&root.join(source))) {
            let text = fs::read_to_string(&path).unwrap();
            let file = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            for item in &file.items {
                types.add(item, &mut own_docs);
            }
        }
        for (name, read_as) in READ_AS {
            let shape = types.read_as(read_as, &own_docs[*name]);
            types.0.get_mut(*name).unwrap().shape = shape;
        }
        types.settle_defaults();
        types
    }

    pub(crate) fn get(&self, name: &str) -> &Described {
        self.0.get(name).unwrap_or_else(|| panic!("no type {name} in SOURCES; add its file there"))
    }

    /// Returns the kind of a key with aliases resolved.
    pub(crate) fn kind_of<'a>(&'a self, kind: &'a Kind) -> &'a Kind {
        match kind {
            Kind::Named(name) => match &self.get(name).shape {
                Shape::As(other) => self.kind_of(other),
                _ => kind,
            },
            _ => kind,
        }
    }

    /// Returns the table of a key, or of its list, and whether it is a list.
    pub(crate) fn table_of<'a>(&'a self, kind: &'a Kind) -> Option<(&'a str, bool)> {
        match self.kind_of(kind) {
            Kind::Named(name) => {
                let is_table =
                    matches!(self.get(name).shape, Shape::Table(_) | Shape::Tagged { .. });
                is_table.then_some((name, false))
            }
            Kind::List(inner) => self.table_of(inner).map(|(name, _)| (name, true)),
            _ => None,
        }
    }

    /// Returns the keys of a table; for a tagged table, those of a variant.
    pub(crate) fn keys(&self, table: &str, variant: Option<&str>) -> &[Key] {
        match &self.get(table).shape {
            Shape::Table(keys) => keys,
            Shape::Tagged { variants, .. } => {
                let named = |v: &&Variant| variant.is_none_or(|name| name == v.name);
                &variants.iter().find(named).unwrap().keys
            }
            _ => panic!("{table} is not a table"),
        }
    }

    fn add(&mut self, item: &Item, own_docs: &mut BTreeMap<String, BTreeMap<String, String>>) {
        let (name, attributes) = match item {
            Item::Struct(item) => (item.ident.to_string(), &item.attrs),
            Item::Enum(item) => (item.ident.to_string(), &item.attrs),
            _ => return,
        };
        let serde = serde_of(attributes);
        let derived = derives(attributes, "Deserialize");
        let mut default = None;
        let shape = match item {
            _ if serde.contains_key("try_from") => {
                Shape::As(kind_of(&syn::parse_str(serde["try_from"].as_deref().unwrap()).unwrap()))
            }
            Item::Struct(item) if derived => {
                Shape::Table(keys_of(&item.fields, serde.contains_key("default")))
            }
            Item::Struct(item) => {
                let documented = item.fields.iter().filter_map(|field| {
                    Some((field.ident.as_ref()?.to_string(), doc_of(&field.attrs)))
                });
                own_docs.insert(name.clone(), documented.collect());
                Shape::Word(Vec::new())
            }
            Item::Enum(item) => {
                let mut variants = Vec::new();
                for variant in &item.variants {
                    let ident = variant.ident.to_string();
                    let (mut written, mut doc) = (None, doc_of(&variant.attrs));
                    if derived {
                        let own = serde_of(&variant.attrs).get("rename").cloned().flatten();
                        let rule = serde.get("rename_all").cloned().flatten();
                        written = own.or_else(|| Some(in_case(&ident, &rule.unwrap_or_default())));
                    } else if let Some((word, rest)) =
                        doc.strip_prefix('`').and_then(|doc| doc.split_once("`: "))
                    {
                        (written, doc) = (Some(word.to_owned()), rest.to_owned());
                    }
                    // An enum that is neither deserialized nor documents its words does not occur in a file.
                    let Some(written) = written else { return };
                    if variant.attrs.iter().any(|attribute| attribute.path().is_ident("default")) {
                        default = Some(written.clone());
                    }
                    let keys = keys_of(&variant.fields, false);
                    variants.push(Variant { name: written, doc, keys });
                }
                match serde.get("tag").cloned().flatten() {
                    Some(tag) => Shape::Tagged { tag, variants },
                    None => Shape::Word(variants),
                }
            }
            _ => return,
        };
        let doc = doc_of(attributes);
        let taken = self.0.insert(name.clone(), Described { doc, shape, default });
        assert!(taken.is_none(), "two types are named {name}");
    }

    /// Returns the shape of a type with its own deserializer; keys without documentation take that of the
    /// type's fields.
    fn read_as(&self, read_as: &str, own_docs: &BTreeMap<String, String>) -> Shape {
        let kind = kind_of(&syn::parse_str(read_as).unwrap());
        let Kind::Named(name) = &kind else { return Shape::As(kind) };
        let mut keys = self.keys(name, None).to_vec();
        for key in keys.iter_mut().filter(|key| key.doc.is_empty()) {
            let doc = own_docs.get(&key.name).unwrap_or_else(|| panic!("explain {}", key.name));
            (key.doc, key.unit) = unit_apart(doc);
        }
        Shape::Table(keys)
    }

    /// Fills in the defaults of words.
    fn settle_defaults(&mut self) {
        let words: BTreeMap<_, _> = self
            .0
            .iter()
            .map(|(name, described)| (name.clone(), described.default.clone()))
            .collect();
        for described in self.0.values_mut() {
            let Shape::Table(keys) = &mut described.shape else { continue };
            for key in keys.iter_mut().filter(|key| !key.required && key.default.is_some()) {
                if let Kind::Named(name) = &key.kind {
                    key.default =
                        words.get(name).cloned().flatten().map(|word| format!("\"{word}\""));
                }
            }
        }
    }
}

/// Returns the keys of a struct, or of a variant.
fn keys_of(fields: &Fields, all_have_defaults: bool) -> Vec<Key> {
    let mut keys = Vec::new();
    for field in fields {
        let Some(ident) = &field.ident else { return Vec::new() };
        let serde = serde_of(&field.attrs);
        if serde.contains_key("skip") || serde.contains_key("skip_deserializing") {
            continue;
        }
        let name = serde.get("rename").cloned().flatten().unwrap_or_else(|| ident.to_string());
        let (doc, unit) = unit_apart(&doc_of(&field.attrs));
        let by_server = READ_BY_SERVER.iter().find(|(key, _)| *key == name);
        let kind = match by_server {
            Some((_, server)) => kind_of(&syn::parse_str(server).unwrap()),
            None => kind_of(&field.ty),
        };
        let optional = is_option(&field.ty);
        let required = !all_have_defaults && !serde.contains_key("default") && !optional;
        let by_function = serde.get("default").cloned().flatten().is_some();
        let default = (!required && !optional && !by_function).then(|| zero(&kind)).flatten();
        keys.push(Key { name, doc, unit, kind, required, default });
    }
    keys
}

/// Returns the text of a kind's `Default`; words follow later.
fn zero(kind: &Kind) -> Option<String> {
    match kind {
        Kind::Number => Some("0.0".to_owned()),
        Kind::Integer => Some("0".to_owned()),
        Kind::Flag => Some("false".to_owned()),
        Kind::Vector(count) | Kind::Numbers(count) => {
            Some(format!("[{}]", vec!["0.0"; *count].join(", ")))
        }
        Kind::Named(_) => Some(String::new()),
        Kind::Text | Kind::List(_) | Kind::Free => None,
    }
}

fn kind_of(of: &Type) -> Kind {
    match of {
        Type::Array(array) => match &array.len {
            Expr::Lit(ExprLit { lit: Lit::Int(count), .. }) => {
                Kind::Numbers(count.base10_parse().unwrap())
            }
            _ => Kind::Named("a list whose length is not a literal".to_owned()),
        },
        Type::Path(path) => {
            let segments = &path.path.segments;
            let last = segments.last().unwrap();
            match last.ident.to_string().as_str() {
                "f64" => Kind::Number,
                "u16" | "u32" | "i32" => Kind::Integer,
                "bool" => Kind::Flag,
                "String" | "Ipv4Addr" => Kind::Text,
                "DVec2" => Kind::Vector(2),
                "DVec3" => Kind::Vector(3),
                "BTreeMap" => Kind::Free,
                "Table" if segments.len() > 1 => Kind::Free,
                "Option" => kind_of(argument(last)),
                "Vec" => Kind::List(Box::new(kind_of(argument(last)))),
                name => Kind::Named(name.to_owned()),
            }
        }
        // Types of messages next to the tables; if a table uses one, Types::get panics.
        _ => Kind::Named("a type that TOML does not have".to_owned()),
    }
}

fn argument(segment: &syn::PathSegment) -> &Type {
    let PathArguments::AngleBracketed(arguments) = &segment.arguments else {
        panic!("{} without its type", segment.ident)
    };
    match arguments.args.first() {
        Some(GenericArgument::Type(argument)) => argument,
        _ => panic!("{} without its type", segment.ident),
    }
}

fn is_option(of: &Type) -> bool {
    matches!(of, Type::Path(path) if path.path.segments.last().is_some_and(|s| s.ident == "Option"))
}

/// Returns the words in `[serde(...)]` with their values.
fn serde_of(attributes: &[Attribute]) -> BTreeMap<String, Option<String>> {
    let mut words = BTreeMap::new();
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("serde")) {
        let read = attribute.parse_nested_meta(|meta| {
            let word = meta.path.get_ident().unwrap().to_string();
            let value = if meta.input.peek(Token![=]) {
                Some(meta.value()?.parse::<LitStr>()?.value())
            } else {
                None
            };
            words.insert(word, value);
            Ok(())
        });
        read.expect("serde's attributes are words and strings");
    }
    words
}

fn derives(attributes: &[Attribute], what: &str) -> bool {
    let mut found = false;
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("derive")) {
        let read = attribute.parse_nested_meta(|meta| {
            found |= meta.path.segments.last().is_some_and(|segment| segment.ident == what);
            Ok(())
        });
        read.expect("derives are a list of names");
    }
    found
}

/// Returns the first paragraph of a doc comment in one line.
fn doc_of(attributes: &[Attribute]) -> String {
    let mut lines = Vec::new();
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("doc")) {
        let syn::Meta::NameValue(doc) = &attribute.meta else { continue };
        let Expr::Lit(ExprLit { lit: Lit::Str(line), .. }) = &doc.value else { continue };
        let line = line.value().trim().to_owned();
        if line.is_empty() {
            break;
        }
        lines.push(line);
    }
    lines.join(" ")
}

/// Returns the description of a key, and its unit and frame, which are in brackets at the end.
fn unit_apart(doc: &str) -> (String, String) {
    let cut = doc.strip_suffix(']').and_then(|doc| doc.rsplit_once('['));
    match cut {
        Some((said, unit)) if !unit.starts_with('`') => {
            (said.trim_end().to_owned(), unit.to_owned())
        }
        _ => (doc.to_owned(), String::new()),
    }
}

/// Returns the name of a variant in serde's `rename_all` case.
fn in_case(ident: &str, rule: &str) -> String {
    let between = match rule {
        "kebab-case" => "-",
        "snake_case" => "_",
        "lowercase" => "",
        "" => return ident.to_owned(),
        _ => panic!("rename_all = \"{rule}\" is unknown: add it here"),
    };
    let mut name = String::new();
    for (index, letter) in ident.chars().enumerate() {
        if letter.is_uppercase() && index > 0 {
            name.push_str(between);
        }
        name.extend(letter.to_lowercase());
    }
    name
}

/// Returns a file, or the Rust files of a folder without tests, sorted by name.
fn rust_files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = fs::read_dir(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let mut files = Vec::new();
    for path in paths {
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|end| end == "rs") && !path.ends_with("tests.rs") {
            files.push(path);
        }
    }
    files
}

//! In each crate, at most three files may import each other in a cycle, so that a reader needs no more files at once.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use cargo_metadata::MetadataCommand;
use syn::visit::{self, Visit};
use syn::{Attribute, ItemFn, ItemImpl, ItemMod, ItemUse, UseTree, Visibility};

/// Maximum number of files in a cycle.
const LARGEST: usize = 3;
/// Path of names from the root of a crate.
type Module = Vec<String>;

#[test]
fn at_most_three_files_import_each_other() {
    let metadata = MetadataCommand::new().no_deps().exec().expect("cargo metadata");
    let mut files = 0;
    for package in metadata.workspace_packages() {
        let source = package.manifest_path.parent().expect("a folder").join("src");
        let modules = Modules::read(source.as_std_path());
        files += modules.0.len();
        let largest = modules.circles().into_iter().max_by_key(BTreeSet::len).unwrap_or_default();
        assert!(
            largest.len() <= LARGEST,
            "{}: these import each other; move what they share into a file of its own: {largest:?}",
            package.name
        );
    }
    assert!(files > 500, "the sources have moved: {files} files found");
}

#[test]
fn finds_a_cycle_through_a_re_export() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    write("lib.rs", "mod a; mod b; pub use b::B;");
    write("a.rs", "use crate::B; pub struct A; #[cfg(test)] mod tests { use crate::c::C; }");
    write("b.rs", "pub struct B; fn f() -> super::a::A { super::a::A }");
    write("c.rs", "use crate::a::A;");
    let circles = Modules::read(folder.path()).circles();
    let expected: BTreeSet<Module> = [vec!["a".to_owned()], vec!["b".to_owned()]].into();
    assert_eq!(circles, [expected].into());
}

/// Files of a crate by module.
struct Modules(BTreeMap<Module, Imports>);

impl Modules {
    fn read(source: &Path) -> Self {
        let mut modules = BTreeMap::new();
        for path in rust_files(source) {
            let inside = path.strip_prefix(source).unwrap().with_extension("");
            let mut module: Module =
                inside.iter().map(|name| name.to_str().unwrap().to_owned()).collect();
            if module.iter().any(|name| name == "tests" || name == "bin") {
                continue;
            }
            match module.last().map(String::as_str) {
                Some("main") if source.join("lib.rs").exists() => continue,
                Some("mod" | "lib" | "main") => drop(module.pop()),
                _ => {}
            }
            let mut imports = Imports::default();
            let file = syn::parse_file(&fs::read_to_string(&path).unwrap());
            imports.visit_file(&file.unwrap_or_else(|error| panic!("{}: {error}", path.display())));
            modules.insert(module, imports);
        }
        Self(modules)
    }

    /// Returns the file that defines a path, as seen from a module.
    fn resolve(&self, from: &Module, path: &[String]) -> Option<Module> {
        let (mut module, mut rest) = match path.first()?.as_str() {
            "crate" => (Module::new(), &path[1..]),
            "self" => (from.clone(), &path[1..]),
            "super" => (from.clone(), path),
            child => {
                let child = [from.as_slice(), &[child.to_owned()]].concat();
                self.0.contains_key(&child).then_some((child, &path[1..]))?
            }
        };
        while rest.first().is_some_and(|name| name == "super") {
            module.pop()?;
            rest = &rest[1..];
        }
        while let Some(name) = rest.first() {
            let child = [module.as_slice(), std::slice::from_ref(name)].concat();
            if self.0.contains_key(&child) {
                module = child;
                rest = &rest[1..];
            } else if let Some(target) = self.0.get(&module)?.re_exports.get(name) {
                return self.resolve(&module, &[target, &rest[1..]].concat());
            } else {
                break;
            }
        }
        self.0.contains_key(&module).then_some(module)
    }

    /// Returns the groups of files that import each other, directly or indirectly.
    fn circles(&self) -> BTreeSet<BTreeSet<Module>> {
        let imported = |module: &Module| -> Vec<Module> {
            let paths = &self.0[module].paths;
            paths.iter().filter_map(|path| self.resolve(module, path)).collect()
        };
        let reached: BTreeMap<&Module, BTreeSet<Module>> = self
            .0
            .keys()
            .map(|module| {
                let (mut reached, mut next) = (BTreeSet::new(), imported(module));
                while let Some(module) = next.pop() {
                    if reached.insert(module.clone()) {
                        next.extend(imported(&module));
                    }
                }
                (module, reached)
            })
            .collect();
        let circle = |(module, own): (&&Module, &BTreeSet<Module>)| -> BTreeSet<Module> {
            own.iter().filter(|other| reached[other].contains(*module)).cloned().collect()
        };
        reached.iter().map(circle).filter(|circle| circle.len() > 1).collect()
    }
}

/// Names that the code of a file imports from other files, without its tests.
#[derive(Default)]
struct Imports {
    paths: Vec<Vec<String>>,
    /// `pub use` items by their exported name.
    re_exports: BTreeMap<String, Vec<String>>,
}

impl Imports {
    fn add_use(&mut self, is_public: bool, tree: &UseTree, before: &[String]) {
        let with = |name: &syn::Ident| [before, &[name.to_string()]].concat();
        let (path, name) = match tree {
            UseTree::Path(path) => return self.add_use(is_public, &path.tree, &with(&path.ident)),
            UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.add_use(is_public, tree, before));
            }
            UseTree::Name(name) if name.ident == "self" => {
                (before.to_vec(), before.last().cloned().unwrap_or_default())
            }
            UseTree::Name(name) => (with(&name.ident), name.ident.to_string()),
            UseTree::Rename(rename) => (with(&rename.ident), rename.rename.to_string()),
            UseTree::Glob(_) => (before.to_vec(), String::new()),
        };
        if is_public {
            self.re_exports.insert(name, path);
        } else {
            self.paths.push(path);
        }
    }
}

impl<'ast> Visit<'ast> for Imports {
    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        if !is_test(&item.attrs) {
            self.add_use(!matches!(item.vis, Visibility::Inherited), &item.tree, &[]);
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let names: Vec<_> = path.segments.iter().map(|part| part.ident.to_string()).collect();
        if names.len() > 1 && ["crate", "super", "self"].contains(&names[0].as_str()) {
            self.paths.push(names);
        }
        visit::visit_path(self, path);
    }

    // Inline modules have another `super`; almost all of them are tests.
    fn visit_item_mod(&mut self, _: &'ast ItemMod) {}

    fn visit_item_fn(&mut self, item: &'ast ItemFn) {
        if !is_test(&item.attrs) {
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_item_impl(&mut self, item: &'ast ItemImpl) {
        if !is_test(&item.attrs) {
            visit::visit_item_impl(self, item);
        }
    }
}

fn is_test(attributes: &[Attribute]) -> bool {
    let is_cfg_test = |attribute: &Attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Ident>().is_ok_and(|name| name == "test")
    };
    attributes.iter().any(is_cfg_test)
}

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let files = entries.flat_map(|entry| {
        let path = entry.unwrap().path();
        if path.is_dir() { rust_files(&path) } else { vec![path] }
    });
    files.filter(|path| path.extension().is_some_and(|kind| kind == "rs")).collect()
}

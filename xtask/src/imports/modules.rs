//! The modules of a crate, read from its sources, and which of them use which.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use proc_macro2::{Ident, TokenStream, TokenTree};
use syn::visit::{self, Visit};
use syn::{Attribute, ImplItemFn, Item, ItemMod, ItemUse, Macro, UseTree, VisRestricted, Visibility};

/// Longest chain of re-exports that is followed.
const CHAIN_MAX: usize = 16;

/// A path as it is written, without generic arguments.
type Segments = Vec<String>;

/// A place in a module that names something.
struct Named {
    path: Segments,
    line: usize,
    /// It ends with `*`: what it names is a module.
    glob: bool,
}

/// One module.
#[derive(Default)]
pub(super) struct Module {
    pub(super) parent: Option<usize>,
    /// From the root on, `crate` first.
    pub(super) path: Segments,
    pub(super) file: PathBuf,
    children: BTreeMap<String, usize>,
    /// Names of what it defines itself.
    items: BTreeSet<String>,
    /// Names that an import gives to what is elsewhere.
    aliases: BTreeMap<String, Segments>,
    /// Modules all of whose names are re-exported.
    globs: Vec<Segments>,
    named: Vec<Named>,
}

/// A use of one module by another.
pub(super) struct Use {
    pub(super) from: usize,
    pub(super) to: usize,
    /// Where it is written first.
    pub(super) line: usize,
    pub(super) path: String,
}

/// The modules of a crate, the root first.
pub(super) struct Modules(pub(super) Vec<Module>);

impl Modules {
    /// Reads a crate from the file of its root.
    pub(super) fn read(root: &Path) -> Result<Self> {
        let mut modules = Self(Vec::new());
        let folder = root.parent().context("a source file lies in a folder")?;
        modules.add_file(None, "crate", root, folder)?;
        Ok(modules)
    }

    /// Every pair of modules of which the first uses the second, once.
    pub(super) fn uses(&self) -> Vec<Use> {
        let mut uses = Vec::new();
        let mut seen = BTreeSet::new();
        for (from, module) in self.0.iter().enumerate() {
            for named in &module.named {
                // a name that was not imported is one of the module itself, or a variable
                let is_own = named.path.len() == 1 && !module.aliases.contains_key(&named.path[0]);
                let target = self.resolve(from, &named.path, 0).filter(|to| *to != from && !is_own);
                if let Some(to) = target.filter(|to| seen.insert((from, *to))) {
                    let all = if named.glob { "::*" } else { "" };
                    let path = named.path.join("::") + all;
                    uses.push(Use { from, to, line: named.line, path });
                }
            }
        }
        uses
    }

    /// The module that defines what a path names in a module; `None` where that is no module of this crate.
    fn resolve(&self, from: usize, path: &[String], depth: usize) -> Option<usize> {
        let (first, rest) = path.split_first()?;
        let module = self.0.get(from)?;
        match first.as_str() {
            "crate" => self.descend(0, rest, depth),
            "self" => self.descend(from, rest, depth),
            "super" if rest.first().is_some_and(|next| next == "super") => {
                self.resolve(module.parent?, rest, depth)
            }
            "super" => self.descend(module.parent?, rest, depth),
            name => match module.children.get(name) {
                Some(child) => self.descend(*child, rest, depth),
                None => self.through_alias(from, name, rest, depth),
            },
        }
    }

    /// The same for a path that starts in a module, whatever that has imported included.
    fn descend(&self, at: usize, path: &[String], depth: usize) -> Option<usize> {
        let Some((first, rest)) = path.split_first() else { return Some(at) };
        let module = self.0.get(at)?;
        if let Some(child) = module.children.get(first) {
            return self.descend(*child, rest, depth);
        }
        if module.aliases.contains_key(first) {
            return self.through_alias(at, first, rest, depth).or(Some(at));
        }
        if module.items.contains(first) || depth >= CHAIN_MAX {
            return Some(at);
        }
        let places = module.globs.iter().filter_map(|glob| self.resolve(at, glob, depth + 1));
        let mut known = places.filter(|place| self.0.get(*place).is_some_and(|place| place.knows(first)));
        known.next().and_then(|place| self.descend(place, path, depth + 1)).or(Some(at))
    }

    /// The same for a name that an import of the module stands for.
    fn through_alias(&self, at: usize, name: &str, rest: &[String], depth: usize) -> Option<usize> {
        let alias = self.0.get(at)?.aliases.get(name)?;
        // a macro is re-exported under its own name
        if depth >= CHAIN_MAX || alias.first().is_some_and(|first| first == name) {
            return None;
        }
        let path: Vec<_> = alias.iter().chain(rest).cloned().collect();
        self.resolve(at, &path, depth + 1)
    }

    /// Adds the module of a file; its children's files are in `folder`.
    fn add_file(&mut self, parent: Option<usize>, name: &str, file: &Path, folder: &Path) -> Result<usize> {
        let text = fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
        let source = syn::parse_file(&text).with_context(|| format!("cannot parse {}", file.display()))?;
        self.add(parent, name, file, folder, &source.items)
    }

    fn add(
        &mut self,
        parent: Option<usize>,
        name: &str,
        file: &Path,
        folder: &Path,
        items: &[Item],
    ) -> Result<usize> {
        let index = self.0.len();
        let above = parent.and_then(|parent| self.0.get(parent));
        let mut path = above.map(|above| above.path.clone()).unwrap_or_default();
        path.push(name.to_owned());
        let defined = items.iter().filter_map(|item| parts(item).1).map(Ident::to_string).collect();
        let mut module =
            Module { parent, path, file: file.to_path_buf(), items: defined, ..Module::default() };
        items.iter().for_each(|item| module.visit_item(item));
        self.0.push(module);
        for item in items {
            let Item::Mod(inner) = item else { continue };
            if is_test(&inner.attrs) {
                continue;
            }
            let child = self.add_child(index, file, folder, inner)?;
            self.0[index].children.insert(inner.ident.to_string(), child);
        }
        Ok(index)
    }

    fn add_child(&mut self, parent: usize, file: &Path, folder: &Path, inner: &ItemMod) -> Result<usize> {
        let name = inner.ident.to_string();
        let below = folder.join(&name);
        if let Some((_, items)) = &inner.content {
            return self.add(Some(parent), &name, file, &below, items);
        }
        let beside = folder.join(format!("{name}.rs"));
        let file = if beside.exists() { beside } else { below.join("mod.rs") };
        self.add_file(Some(parent), &name, &file, &below)
    }
}

impl Module {
    fn knows(&self, name: &str) -> bool {
        self.children.contains_key(name) || self.aliases.contains_key(name) || self.items.contains(name)
    }

    fn name(&mut self, path: Segments, line: usize) {
        if !path.is_empty() {
            self.named.push(Named { path, line, glob: false });
        }
    }

    /// Takes an import apart. A re-export is a name for others; it is a use where the module itself uses the name.
    fn import(&mut self, prefix: &[String], tree: &UseTree, is_reexport: bool) {
        let joined = |name: &dyn ToString| [prefix, &[name.to_string()]].concat();
        let (alias, path, line) = match tree {
            UseTree::Path(path) => return self.import(&joined(&path.ident), &path.tree, is_reexport),
            UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.import(prefix, tree, is_reexport));
            }
            UseTree::Glob(glob) => {
                let line = glob.star_token.spans[0].start().line;
                if is_reexport {
                    self.globs.push(prefix.to_vec());
                } else {
                    self.named.push(Named { path: prefix.to_vec(), line, glob: true });
                }
                return;
            }
            UseTree::Name(name) if name.ident == "self" => {
                (prefix.last().cloned(), prefix.to_vec(), name.ident.span().start().line)
            }
            UseTree::Name(name) => {
                (Some(name.ident.to_string()), joined(&name.ident), name.ident.span().start().line)
            }
            UseTree::Rename(rename) => {
                let path = if rename.ident == "self" { prefix.to_vec() } else { joined(&rename.ident) };
                (Some(rename.rename.to_string()), path, rename.ident.span().start().line)
            }
        };
        if let Some(alias) = alias {
            self.aliases.insert(alias, path.clone());
        }
        if !is_reexport {
            self.name(path, line);
        }
    }

    /// The paths inside of a macro's arguments, which are tokens only.
    fn scan(&mut self, tokens: TokenStream) {
        let mut path = Segments::new();
        let (mut colons, mut line) = (0, 0);
        for token in tokens {
            match token {
                TokenTree::Punct(punct) if punct.as_char() == ':' && !path.is_empty() => {
                    colons += 1;
                    continue;
                }
                TokenTree::Ident(ident) => {
                    if colons != 2 {
                        self.name(std::mem::take(&mut path), line);
                        line = ident.span().start().line;
                    }
                    path.push(ident.to_string());
                    colons = 0;
                    continue;
                }
                TokenTree::Group(group) => self.scan(group.stream()),
                TokenTree::Punct(_) | TokenTree::Literal(_) => {}
            }
            self.name(std::mem::take(&mut path), line);
            colons = 0;
        }
        self.name(path, line);
    }
}

impl<'ast> Visit<'ast> for Module {
    fn visit_item(&mut self, item: &'ast Item) {
        // a module of its own is none of this one
        if !matches!(item, Item::Mod(_)) && !is_test(parts(item).0) {
            visit::visit_item(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, function: &'ast ImplItemFn) {
        if !is_test(&function.attrs) {
            visit::visit_impl_item_fn(self, function);
        }
    }

    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        // what starts with `::` is another crate's
        if item.leading_colon.is_none() {
            self.import(&[], &item.tree, !matches!(item.vis, Visibility::Inherited));
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let segments = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        let line = path.segments.first().map_or(0, |first| first.ident.span().start().line);
        if path.leading_colon.is_none() {
            self.name(segments, line);
        }
        visit::visit_path(self, path);
    }

    /// Who may see an item is no use of them.
    fn visit_vis_restricted(&mut self, _: &'ast VisRestricted) {}

    fn visit_macro(&mut self, call: &'ast Macro) {
        self.scan(call.tokens.clone());
        visit::visit_macro(self, call);
    }
}

/// Whether something is there for tests alone, which may use what they like.
fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Path>().is_ok_and(|condition| condition.is_ident("test"))
    })
}

/// The attributes of an item, and its name.
fn parts(item: &Item) -> (&[Attribute], Option<&Ident>) {
    match item {
        Item::Const(item) => (&item.attrs, Some(&item.ident)),
        Item::Enum(item) => (&item.attrs, Some(&item.ident)),
        Item::Fn(item) => (&item.attrs, Some(&item.sig.ident)),
        Item::Impl(item) => (&item.attrs, None),
        Item::Macro(item) => (&item.attrs, item.ident.as_ref()),
        Item::Static(item) => (&item.attrs, Some(&item.ident)),
        Item::Struct(item) => (&item.attrs, Some(&item.ident)),
        Item::Trait(item) => (&item.attrs, Some(&item.ident)),
        Item::Type(item) => (&item.attrs, Some(&item.ident)),
        Item::Use(item) => (&item.attrs, None),
        _ => (&[], None),
    }
}

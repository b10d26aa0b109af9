//! Reads the tokens of one Rust file: its modules, its imports, and every path.

use std::collections::BTreeSet;
use std::iter::Peekable;
use std::vec::IntoIter;

use proc_macro2::{Delimiter, Group, TokenStream, TokenTree};

/// Keywords that begin the definition of a named item.
const DEFINITIONS: [&str; 8] = ["struct", "enum", "trait", "fn", "type", "const", "static", "union"];

/// The contents of a module, without its child modules.
#[derive(Default)]
pub(super) struct Contents {
    pub(super) declared: Vec<Declaration>,
    pub(super) imports: Vec<Import>,
    pub(super) paths: Vec<Path>,
    /// Names of the items that the module defines.
    pub(super) defined: BTreeSet<String>,
}

/// `mod name;` or `mod name { body }`.
pub(super) struct Declaration {
    pub(super) name: String,
    /// The value of `#[path = "…"]`.
    pub(super) file: Option<String>,
    pub(super) body: Option<TokenStream>,
}

/// One name of a `use` item.
pub(super) struct Import {
    /// The name that it brings into scope; `None` for `*`.
    pub(super) name: Option<String>,
    pub(super) path: Path,
}

/// At least one segment, and the line of the first one.
#[derive(Clone)]
pub(super) struct Path {
    pub(super) segments: Vec<String>,
    pub(super) line: usize,
}

type Tokens = Peekable<IntoIter<TokenTree>>;

fn peekable(tokens: TokenStream) -> Tokens {
    tokens.into_iter().collect::<Vec<_>>().into_iter().peekable()
}

/// Reads the tokens of a file, or of the body of a module.
pub(super) fn read(tokens: TokenStream) -> Contents {
    let mut contents = Contents::default();
    contents.read(tokens, true);
    contents
}

impl Contents {
    /// `items` says that the tokens are the module's items, and not the tokens inside an item.
    fn read(&mut self, tokens: TokenStream, items: bool) {
        let mut tokens = peekable(tokens);
        let mut attributes: Vec<TokenStream> = Vec::new();
        while let Some(token) = tokens.next() {
            match token {
                TokenTree::Punct(punct) if punct.as_char() == '#' => {
                    tokens.next_if(|next| is(next, '!'));
                    if let Some(group) = bracketed(&mut tokens) {
                        self.read_attribute(&group);
                        attributes.push(group.stream());
                    }
                    if attributes.last().is_some_and(|attribute| attribute.to_string() == "cfg (test)") {
                        skip_item(&mut tokens);
                        attributes.clear();
                    }
                    continue;
                }
                // The attributes of an item stand before its visibility.
                TokenTree::Ident(ident) if ident == "pub" => {
                    tokens.next_if(|next| is_group(next, Delimiter::Parenthesis));
                    continue;
                }
                TokenTree::Ident(ident) => {
                    let line = ident.span().start().line;
                    let name = plain(&ident.to_string());
                    match name.as_str() {
                        "mod" => self.read_module(&mut tokens, &attributes),
                        "use" => self.read_use(&mut tokens, &[]),
                        keyword if items && DEFINITIONS.contains(&keyword) => {
                            if let Some(TokenTree::Ident(defined)) = tokens.peek() {
                                self.defined.insert(plain(&defined.to_string()));
                            }
                        }
                        _ => self.read_path(&mut tokens, Path { segments: vec![name], line }),
                    }
                }
                // A name after `.` or a leading `::` is not relative to this module.
                TokenTree::Punct(punct) if [':', '.'].contains(&punct.as_char()) => {
                    if punct.as_char() == '.' || colons_follow_one(&mut tokens) {
                        tokens.next_if(|next| matches!(next, TokenTree::Ident(_)));
                    }
                }
                TokenTree::Group(group) => self.read(group.stream(), false),
                TokenTree::Punct(_) | TokenTree::Literal(_) => {}
            }
            attributes.clear();
        }
    }

    /// Attributes may hold paths in strings, as serde's do. The string of a doc comment is only text.
    fn read_attribute(&mut self, group: &Group) {
        let stream = group.stream();
        if matches!(stream.clone().into_iter().next(), Some(TokenTree::Ident(name)) if name == "doc") {
            return;
        }
        self.read_strings(stream.clone());
        self.read(stream, false);
    }

    fn read_strings(&mut self, tokens: TokenStream) {
        for token in tokens {
            match token {
                TokenTree::Group(group) => self.read_strings(group.stream()),
                TokenTree::Literal(literal) => {
                    let text = literal.to_string();
                    let segments: Vec<_> = text.trim_matches('"').split("::").map(str::to_owned).collect();
                    if ["crate", "self", "super"].contains(&segments[0].as_str()) {
                        self.paths.push(Path { segments, line: literal.span().start().line });
                    }
                }
                TokenTree::Ident(_) | TokenTree::Punct(_) => {}
            }
        }
    }

    fn read_module(&mut self, tokens: &mut Tokens, attributes: &[TokenStream]) {
        let Some(TokenTree::Ident(name)) = tokens.next() else { return };
        let body = match tokens.next_if(|next| is_group(next, Delimiter::Brace)) {
            Some(TokenTree::Group(group)) => Some(group.stream()),
            _ => None,
        };
        let file = attributes.iter().find_map(|attribute| {
            let text = attribute.to_string();
            Some(text.strip_prefix("path = \"")?.strip_suffix('"')?.to_owned())
        });
        self.declared.push(Declaration { name: plain(&name.to_string()), file, body });
    }

    /// Reads one branch of a `use` tree up to the next `,` or `;`. `use<'a>` in a type has no segment and is ignored.
    fn read_use(&mut self, tokens: &mut Tokens, prefix: &[String]) {
        let mut segments = prefix.to_vec();
        let mut line = 0;
        let mut alias = None;
        while let Some(token) = tokens.next_if(|next| !is(next, ';') && !is(next, ',') && !is(next, '<')) {
            match token {
                TokenTree::Ident(ident) if ident == "as" => alias = tokens.next().map(|name| name.to_string()),
                TokenTree::Ident(ident) => {
                    line = ident.span().start().line;
                    segments.push(plain(&ident.to_string()));
                }
                TokenTree::Punct(punct) if punct.as_char() == '*' => {
                    self.imports.push(Import { name: None, path: Path { segments, line: punct.span().start().line } });
                    return;
                }
                TokenTree::Group(group) => {
                    let mut branches = peekable(group.stream());
                    while branches.peek().is_some() {
                        self.read_use(&mut branches, &segments);
                        branches.next();
                    }
                    return;
                }
                TokenTree::Punct(_) | TokenTree::Literal(_) => {}
            }
        }
        if segments.len() > 1 && segments.last().is_some_and(|last| last == "self") {
            segments.pop();
        }
        if line > 0 {
            let name = alias.or_else(|| segments.last().cloned());
            self.imports.push(Import { name, path: Path { segments, line } });
        }
    }

    /// Reads the rest of a path after its first segment.
    fn read_path(&mut self, tokens: &mut Tokens, mut path: Path) {
        while tokens.next_if(|next| is(next, ':')).is_some() && colons_follow_one(tokens) {
            match tokens.next_if(|next| matches!(next, TokenTree::Ident(_))) {
                Some(segment) => path.segments.push(plain(&segment.to_string())),
                None => break,
            }
        }
        if path.segments.len() > 1 {
            self.paths.push(path);
        }
    }
}

/// Reads the second `:` of `::`, and says whether it was there.
fn colons_follow_one(tokens: &mut Tokens) -> bool {
    tokens.next_if(|next| is(next, ':')).is_some()
}

fn bracketed(tokens: &mut Tokens) -> Option<Group> {
    match tokens.next_if(|next| is_group(next, Delimiter::Bracket)) {
        Some(TokenTree::Group(group)) => Some(group),
        _ => None,
    }
}

/// Reads to the end of an item: a `;`, or braces. The braces of a `use` tree also end it; the `;` that is left has no effect.
fn skip_item(tokens: &mut Tokens) {
    for token in tokens.by_ref() {
        if is(&token, ';') || is_group(&token, Delimiter::Brace) {
            return;
        }
    }
}

fn is(token: &TokenTree, character: char) -> bool {
    matches!(token, TokenTree::Punct(punct) if punct.as_char() == character)
}

fn is_group(token: &TokenTree, delimiter: Delimiter) -> bool {
    matches!(token, TokenTree::Group(group) if group.delimiter() == delimiter)
}

fn plain(identifier: &str) -> String {
    identifier.trim_start_matches("r#").to_owned()
}

//! The length of source files: one that grows without end holds more than one thing.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};

use crate::workspace::Workspace;

/// Most lines of a file, its tests included.
const LINES_MAX: usize = 500;

/// Fails where a source file of the repository is longer, and names each.
pub(crate) fn check(workspace: &Workspace) -> Result<()> {
    let mut long = Vec::new();
    collect(&workspace.root, &workspace.root, &mut long)?;
    long.sort_unstable();
    ensure!(long.is_empty(), "files of more than {LINES_MAX} lines:\n  {}", long.join("\n  "));
    Ok(())
}

/// Adds the long files below a folder, by their path from the root and with their lines.
fn collect(root: &Path, folder: &Path, long: &mut Vec<String>) -> Result<()> {
    let entries = fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    for entry in entries {
        let entry = entry?;
        let (path, name) = (entry.path(), entry.file_name());
        // what cargo builds is none of the sources, and a link may lead anywhere
        let is_source = name != "target" && !name.to_string_lossy().starts_with('.');
        if entry.file_type()?.is_dir() && is_source {
            collect(root, &path, long)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text =
                fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
            let lines = text.lines().count();
            if lines > LINES_MAX {
                long.push(format!("{} ({lines})", path.strip_prefix(root).unwrap_or(&path).display()));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_files_are_named_and_what_is_built_is_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let long = "x\n".repeat(LINES_MAX + 1);
        for (name, text) in [
            ("a/long.rs", long.as_str()),
            ("a/short.rs", &long[2..]),
            ("a/table.csv", &long),
            ("target/built.rs", &long),
            (".hidden/one.rs", &long),
        ] {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let workspace = Workspace { root: folder.path().to_path_buf(), target: folder.path().join("target") };
        let error = check(&workspace).unwrap_err().to_string();
        assert!(error.ends_with("lines:\n  a/long.rs (501)"), "{error}");
        fs::remove_file(folder.path().join("a/long.rs")).unwrap();
        check(&workspace).unwrap();
    }
}

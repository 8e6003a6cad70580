//! Packages of Debian and Ubuntu, downloaded and unpacked into the build directory, beside the system: no root, nothing
//! installed, nothing removed.
//!
//! `apt-get` is given a state of its own, in which nothing but the system's C library is installed. So it finds all that a
//! package needs, and what the system has plays no part: there is nothing to upgrade or to remove. It only downloads;
//! `dpkg-deb` unpacks. The system's package lists, cache and database are neither used nor changed.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};

use super::toolbox::Toolbox;
use crate::progress;
use crate::run;

/// Enough for a slow mirror; without a limit a mirror that does not answer would hang the set-up for good.
const UPDATE_LIMIT: Duration = Duration::from_secs(300);
/// Enough for some hundred megabytes over a slow line.
const DOWNLOAD_LIMIT: Duration = Duration::from_secs(1800);
/// Some thousand files.
const UNPACK_LIMIT: Duration = Duration::from_secs(300);
/// `dpkg-query` and its like.
const QUERY_LIMIT: Duration = Duration::from_secs(60);

/// What lists and downloads take on a common line.
const EXPECTED: Duration = Duration::from_secs(30);

/// What every program of the system shares with those that are unpacked: two versions of it in one process do not mix.
const SHARED: [&str; 2] = ["libc6", "libgcc-s1"];

/// Debian's key, as it is installed on Debian and, by a package of this name, on Ubuntu.
const DEBIAN_KEY: &str = "/usr/share/keyrings/debian-archive-keyring.gpg";

/// Where packages come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// What the system itself is installed from.
    System,
    /// These suites of Debian, by the mirror that the system itself is installed from. The last one is preferred.
    Debian(&'static [&'static str]),
}

impl Source {
    /// The name of its folder.
    fn name(self) -> String {
        match self {
            Self::System => "system".into(),
            Self::Debian(suites) => suites.last().copied().unwrap_or_default().into(),
        }
    }
}

/// The folder that holds these packages and all that they need, downloaded and unpacked if they are not there yet.
pub(crate) fn unpack(toolbox: &Toolbox, name: &str, source: Source, packages: &[&str]) -> Result<PathBuf> {
    let folder = toolbox.folder.join(name);
    let root = folder.join("root");
    // Written last, so that an interrupted download is not taken for a whole one.
    let stamp = folder.join("packages.txt");
    let wanted = format!("{} from {}\n", packages.join(" "), source.name());
    if fs::read_to_string(&stamp).is_ok_and(|unpacked| unpacked == wanted) {
        return Ok(root);
    }
    let what = format!("downloading {} into {}", packages.join(", "), toolbox.shown(&folder));
    progress::during(&what, EXPECTED, || {
        let apt = Apt::prepare(toolbox, source)?;
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&root).with_context(|| format!("cannot make {}", root.display()))?;
        for archive in apt.download(packages)? {
            run::quiet(toolbox.command("dpkg-deb")?.arg("--extract").arg(archive).arg(&root), UNPACK_LIMIT)?;
        }
        fs::write(&stamp, &wanted).with_context(|| format!("cannot write {}", stamp.display()))
    })?;
    Ok(root)
}

/// `apt-get` with a state of its own.
struct Apt<'t> {
    toolbox: &'t Toolbox,
    source: Source,
    /// Its lists, its cache and its configuration.
    folder: PathBuf,
}

impl<'t> Apt<'t> {
    /// Makes the state, with package lists of this run: those of last month name files that are gone.
    fn prepare(toolbox: &'t Toolbox, source: Source) -> Result<Self> {
        for program in ["apt-get", "apt-config", "dpkg-deb", "dpkg-query"] {
            ensure!(toolbox.find(program).is_some(), "there is no {program} here");
        }
        let folder = toolbox.folder.join("apt").join(source.name());
        let apt = Self { toolbox, source, folder };
        let fresh = apt.folder.join(format!("updated-by-{}", std::process::id()));
        if fresh.exists() {
            return Ok(apt);
        }
        let _ = fs::remove_dir_all(&apt.folder);
        for folder in ["lists/partial", "archives/partial", "parts"] {
            fs::create_dir_all(apt.folder.join(folder))?;
        }
        fs::write(apt.folder.join("status"), installed(toolbox)?)?;
        if let Source::Debian(suites) = source {
            fs::write(apt.folder.join("sources.list"), sources(toolbox, suites)?)?;
        }
        let system = run::output(toolbox.command("apt-config")?.arg("dump"))?;
        fs::write(apt.configuration(), configuration(&system, &apt.folder, source))?;
        if let Err(error) = run::quiet(apt.get()?.arg("update"), UPDATE_LIMIT) {
            // One of several sources may be gone and not needed; if it is, the download says so and fails.
            println!("setup: going on without some package lists: {error:#}");
        }
        fs::write(fresh, "")?;
        Ok(apt)
    }

    fn configuration(&self) -> PathBuf {
        self.folder.join("apt.conf")
    }

    fn get(&self) -> Result<Command> {
        let mut command = self.toolbox.command("apt-get")?;
        command.env("APT_CONFIG", self.configuration());
        Ok(command)
    }

    /// The archives of the packages and all that they need, the shared ones left out.
    fn download(&self, packages: &[&str]) -> Result<Vec<PathBuf>> {
        let archives = self.folder.join("archives");
        // Those of another tool that were downloaded before are not meant.
        for archive in deb_files(&archives)? {
            fs::remove_file(archive)?;
        }
        let mut command = self.get()?;
        command.args(["install", "--download-only", "--yes", "--no-install-recommends"]);
        if let Source::Debian([.., suite]) = self.source {
            command.args(["--target-release", suite]);
        }
        run::quiet(command.args(packages), DOWNLOAD_LIMIT)?;
        let archives = deb_files(&archives)?;
        if archives.is_empty() {
            bail!("apt-get has downloaded nothing for {}", packages.join(", "));
        }
        Ok(archives)
    }
}

/// apt's configuration: the system's, less what it does to the system, with all of its state in our folder.
fn configuration(system: &str, folder: &Path, source: Source) -> String {
    let keep = |line: &&str| {
        let is_hook = line.starts_with("APT::Update::") || line.starts_with("DPkg::");
        // A dump may hold names that cannot be read back, and the folders are ours.
        !is_hook && !line.starts_with("Dir") && !line.contains("CommandLine")
    };
    let mut text: String = system.lines().filter(keep).flat_map(|line| [line, "\n"]).collect();
    let path = |name: &str| folder.join(name).display().to_string();
    let mut set = |name: &str, value: &str| {
        writeln!(text, "{name} \"{value}\";").expect("a string takes everything");
    };
    set("Dir", "/");
    set("Dir::State", &path(""));
    set("Dir::State::lists", &path("lists"));
    set("Dir::State::status", &path("status"));
    set("Dir::Cache", &path(""));
    set("Dir::Cache::archives", &path("archives"));
    set("Dir::Etc::parts", &path("parts"));
    set("Dir::Etc::main", &path("parts/none"));
    set("Dir::Etc::preferences", &path("parts/none"));
    set("Dir::Etc::preferencesparts", &path("parts"));
    if let Source::Debian(_) = source {
        set("Dir::Etc::sourcelist", &path("sources.list"));
        set("Dir::Etc::sourceparts", &path("parts"));
    }
    // The folder is ours alone, and no other user could write to it.
    set("APT::Sandbox::User", "root");
    set("Debug::NoLocking", "true");
    text
}

/// A package database in which only the shared packages are installed, as they are on this system: where they are too old
/// for what is wanted, apt finds out.
fn installed(toolbox: &Toolbox) -> Result<String> {
    let mut status = String::new();
    for package in SHARED {
        let mut command = toolbox.command("dpkg-query")?;
        command.args(["--show", "--showformat", "${Package} ${Architecture} ${Version}\n", package]);
        let answer = run::output_within(&mut command, QUERY_LIMIT)?;
        let line = answer.lines().next().unwrap_or_default();
        let [name, architecture, version] = line.split(' ').collect::<Vec<_>>()[..] else {
            bail!("dpkg-query says `{line}` of {package}");
        };
        write!(
            status,
            "Package: {name}\nStatus: install ok installed\nArchitecture: {architecture}\nMulti-Arch: same\n\
             Version: {version}\nMaintainer: the system\nDescription: as it is\n\n"
        )?;
    }
    Ok(status)
}

/// The mirror of Debian that the system's own sources name.
pub(crate) fn debian_mirror(toolbox: &Toolbox) -> Result<String> {
    let mut command = toolbox.command("apt-get")?;
    command.args(["indextargets", "--format", "$(REPO_URI) $(RELEASE)", "Created-By: Packages"]);
    let answer = run::output_within(&mut command, QUERY_LIMIT)?;
    let mirror = mirror(&answer).context("the system is not installed from a mirror of Debian")?;
    Ok(mirror.to_owned())
}

/// A list of sources with these suites, by that mirror.
fn sources(toolbox: &Toolbox, suites: &[&str]) -> Result<String> {
    let mirror = debian_mirror(toolbox)?;
    ensure!(Path::new(DEBIAN_KEY).exists(), "there is no {DEBIAN_KEY} to know Debian's packages by");
    Ok(suites.iter().map(|suite| format!("deb [signed-by={DEBIAN_KEY}] {mirror} {suite} main\n")).collect())
}

/// The mirror of Debian among lines of address and suite: the one whose address ends like Debian's own.
fn mirror(targets: &str) -> Option<&str> {
    let addresses = targets.lines().filter_map(|line| Some(line.split_once(' ')?.0));
    addresses.into_iter().find(|address| address.trim_end_matches('/').ends_with("/debian"))
}

fn deb_files(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "deb") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mirror_of_debian_is_told_from_others() {
        let targets = "http://other.example/deb/ stable\nhttp://a.example/debian-security/ x\n\
                       http://a.example/debian/ bookworm\n";
        assert_eq!(mirror(targets), Some("http://a.example/debian/"));
        assert_eq!(mirror("http://a.example/ubuntu noble\n"), None);
    }

    #[test]
    fn apt_keeps_its_proxy_and_loses_its_hooks() {
        let system = "Acquire::http::Proxy \"http://p\";\nAPT::Update::Post-Invoke:: \"rm x\";\nDir \"/\";\n\
                      DPkg::Post-Invoke:: \"y\";\nDir::Cache \"var/cache/apt\";\n";
        let text = configuration(system, Path::new("/f"), Source::Debian(&["bookworm"]));
        assert!(
            text.starts_with("Acquire::http::Proxy \"http://p\";\nDir \"/\";\nDir::State \"/f/\";\n"),
            "{text}"
        );
        assert!(text.contains("Dir::Etc::sourcelist \"/f/sources.list\";"), "{text}");
        assert!(!configuration(system, Path::new("/f"), Source::System).contains("sourcelist"));
    }
}

//! What stands behind the plugin's name on QEMU's command line.

use std::path::PathBuf;

/// Arguments of `-plugin`.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Options {
    /// Whether the board has its crystal.
    pub(super) crystal: bool,
    /// Whether there is a CAN controller.
    pub(super) can: bool,
    /// QEMU ends after the self-test, with success where it has passed.
    pub(super) self_test_only: bool,
    /// Whether the independent watchdog bites.
    pub(super) watchdog: bool,
    /// Where the flash's sectors are kept.
    pub(super) flash: Option<PathBuf>,
}

impl Options {
    pub(super) fn parse<'a>(arguments: impl IntoIterator<Item = &'a str>) -> Result<Self, String> {
        let mut options =
            Self { crystal: true, can: true, self_test_only: false, watchdog: false, flash: None };
        for argument in arguments {
            match argument {
                "crystal=on" => options.crystal = true,
                "crystal=off" => options.crystal = false,
                "can=on" => options.can = true,
                "can=off" => options.can = false,
                "watchdog=on" => options.watchdog = true,
                "watchdog=off" => options.watchdog = false,
                "selftest=only" => options.self_test_only = true,
                other => match other.strip_prefix("flash=") {
                    Some(path) => options.flash = Some(path.into()),
                    None => {
                        return Err(format!(
                            "unknown argument {other:?}; there are crystal=, can=, watchdog=, flash= and selftest=only"
                        ));
                    }
                },
            }
        }
        Ok(options)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_checked() {
        assert_eq!(
            Options::parse([]),
            Ok(Options { crystal: true, can: true, self_test_only: false, watchdog: false, flash: None })
        );
        let all = Options {
            crystal: false,
            can: false,
            self_test_only: true,
            watchdog: true,
            flash: Some("a.bin".into()),
        };
        assert_eq!(
            Options::parse(["crystal=off", "can=off", "selftest=only", "watchdog=on", "flash=a.bin"]),
            Ok(all)
        );
        assert!(Options::parse(["crystal"]).is_err());
    }
}

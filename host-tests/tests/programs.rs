//! The programs of this package, started as a user starts them.

use std::process::Command;

#[test]
fn the_demonstration_in_one_process_finds_every_answer_right() {
    let output =
        Command::new(env!("CARGO_BIN_EXE_demo")).args(["--in-process", "--seconds", "1"]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    for part in ["  TCP       127.0.0.1:", "N.m", "0 timeouts, 0 wrong", "every answer was right"] {
        assert!(text.contains(part), "no {part:?} in:\n{text}");
    }
}

#[test]
fn a_bridge_has_to_be_chosen() {
    for arguments in [&[][..], &["--image", "a.elf"], &["--in-process", "--image", "a", "--plugin", "b"]] {
        let output = Command::new(env!("CARGO_BIN_EXE_demo")).args(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
    }
}

#[cfg(unix)]
#[test]
fn a_missing_image_is_named() {
    let free = ["--host", "--rs485-a", "--rs485-b", "--can"].map(|port| [port, "127.0.0.1:0"]).concat();
    let output = Command::new(env!("CARGO_BIN_EXE_emulate"))
        .args(["--image", "/nowhere/image.elf", "--plugin", "/nowhere/plugin.so"])
        .args(free)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("/nowhere/image.elf"));
}

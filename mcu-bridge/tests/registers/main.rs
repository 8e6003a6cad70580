//! The page of the register map says what the table says.

mod page;

#[test]
fn the_page_is_current() {
    let current = include_str!("../../REGISTERS.md");
    assert_eq!(current, page::page(), "write it anew with the example `registers`");
}

//! The macro behind every code table: written once, both directions from one place, the unknown kept. Codes are
//! bytes where the table names no other type.

macro_rules! code_table {
    (
        $(#[$meta:meta])*
        $name:ident { $($table:tt)+ }
    ) => {
        $crate::codes::code_table! { $(#[$meta])* $name: u8 { $($table)+ } }
    };
    (
        $(#[$meta:meta])*
        $name:ident: $code_type:ty {
            $($(#[$variant_meta:meta])* $variant:ident = $code:literal,)+
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum $name {
            $($(#[$variant_meta])* #[doc = concat!(" (code ", stringify!($code), ").")] $variant,)+
            /// A code that the table does not have, kept as it came.
            Unknown($code_type),
        }

        impl $name {
            /// The value for a code on the wire.
            #[must_use]
            pub const fn from_code(code: $code_type) -> Self {
                match code {
                    $($code => Self::$variant,)+
                    other => Self::Unknown(other),
                }
            }

            /// The code on the wire.
            #[must_use]
            pub const fn code(self) -> $code_type {
                match self {
                    $(Self::$variant => $code,)+
                    Self::Unknown(code) => code,
                }
            }
        }
    };
}

pub(crate) use code_table;

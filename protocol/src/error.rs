//! The macro behind the texts of errors: one line a variant.

macro_rules! error_text {
    ($name:ty { $($pattern:pat => ($($text:tt)+),)+ }) => {
        impl core::fmt::Display for $name {
            fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                match *self {
                    $($pattern => write!(formatter, $($text)+),)+
                }
            }
        }

        impl core::error::Error for $name {}
    };
}

pub(crate) use error_text;

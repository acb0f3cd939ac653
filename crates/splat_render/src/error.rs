//! The error type. Each message names the argument, device or file, and the fix.

/// An error; each displays as one message.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// An argument has a wrong shape, size or value.
    #[error("{argument}: {reason}")]
    Argument {
        /// Name of the argument as the caller wrote it.
        argument: String,
        /// The problem, and a valid value.
        reason: String,
    },
    /// No adapter answers for the backend that was asked for.
    #[error("{0}")]
    NoAdapter(String),
    /// A device cannot be opened, or fails.
    #[error("{0}")]
    Device(String),
    /// A file cannot be read or written.
    #[error("{path}: {reason}")]
    File {
        /// The file.
        path: String,
        /// The problem, and the fix.
        reason: String,
    },
}

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An [`Error::Argument`] in one call.
    pub fn argument(argument: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Argument { argument: argument.into(), reason: reason.into() }
    }

    /// An [`Error::File`] in one call.
    pub fn file(path: impl AsRef<std::path::Path>, reason: impl Into<String>) -> Self {
        let named = path.as_ref().display().to_string();
        let path = if named.is_empty() { r#""""#.to_owned() } else { named };
        Self::File { path, reason: reason.into() }
    }
}

use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::Spanned;

/// What is wrong with a configuration file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: {cause}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// A line is not what is expected there.
    #[error("{}:{line}: {key}: {message}", file.display())]
    Line {
        /// The file.
        file: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The key, or the table where one is missing.
        key: String,
        /// What was expected and what was found.
        message: String,
    },
}

/// A file that is being read: says where in it something is wrong.
#[derive(Debug, Clone, Copy)]
pub(in crate::live) struct Document<'a> {
    pub file: &'a Path,
    pub text: &'a str,
}

impl Document<'_> {
    /// Of `key`, whose value is `value`.
    pub fn fault<T>(
        &self,
        key: &str,
        value: &Spanned<T>,
        message: impl Into<String>,
    ) -> ConfigError {
        self.at(value.span(), key.to_owned(), message.into())
    }

    /// Of what the parser or a type refused.
    pub fn refused(&self, error: &toml::de::Error) -> ConfigError {
        let span = error.span().unwrap_or_default();
        let line = self.text.lines().nth(self.line(span.start) - 1);
        let key = line.unwrap_or_default().split('=').next();
        let key = key.unwrap_or_default().trim().to_owned();
        self.at(span, key, error.message().to_owned())
    }

    fn at(&self, span: Range<usize>, key: String, message: String) -> ConfigError {
        ConfigError::Line {
            file: self.file.to_owned(),
            line: self.line(span.start),
            key,
            message,
        }
    }

    fn line(&self, offset: usize) -> usize {
        let before = self.text.get(..offset).unwrap_or(self.text);
        1 + before.matches('\n').count()
    }

    /// A path as the file means it: from its own folder on.
    pub fn path(&self, path: &Path) -> PathBuf {
        self.folder().join(path)
    }

    /// Where the file is.
    pub fn folder(&self) -> &Path {
        self.file.parent().unwrap_or(Path::new(""))
    }
}

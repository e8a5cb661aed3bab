//! `--config FILE`: options in a TOML file, one key per option.
//!
//! The options of the file become words of the command line, so clap checks them like any other. Options that the
//! command line or the environment gives are left out.

use std::{collections::BTreeSet, ffi::OsString, path::PathBuf};

use checkpoint_store::regular_file::read_small;
use clap::{
    Arg, ArgMatches, Command, Id,
    error::{ContextKind, ContextValue, ErrorKind},
    parser::ValueSource,
};
use serde::Serialize;
use toml::{Table, Value};

/// The option that names the file.
const OPTION: &str = "config";
const VARIABLE: &str = "ROSRESCUE_CONFIG";

/// An option of `core` or `proxy`, its value, and where that comes from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OptionValue {
    /// The option's long name.
    pub option: String,
    /// `None` if the option has none.
    pub value: Option<String>,
    /// `default`, `environment`, `command line`, or the path of the configuration file.
    pub source: String,
}

/// The path of a configuration file, and the options that come from it.
#[derive(Debug, Default)]
pub(crate) struct FromFile {
    path: PathBuf,
    options: BTreeSet<Id>,
}

/// Adds the options of the configuration file to `words`, if they or the environment name one.
///
/// # Errors
///
/// If the file cannot be read, is not TOML, or has an unknown key or a wrong value.
pub(crate) fn insert(command: &Command, words: &mut Vec<OsString>) -> Result<FromFile, String> {
    let is_named = |word: &OsString| word.to_string_lossy().starts_with("--config");
    if std::env::var_os(VARIABLE).is_none() && !words.iter().any(is_named) {
        return Ok(FromFile::default());
    }
    let name = words.get(1).and_then(|word| command.find_subcommand(word));
    let at = words.len().min(1 + usize::from(name.is_some()));
    let loose = command.clone().ignore_errors(true);
    let Ok(matches) = loose.try_get_matches_from(words.iter()) else {
        // The words ask for help or the version.
        return Ok(FromFile::default());
    };
    let given = matches.subcommand().map_or(&matches, |(_, given)| given);
    let Ok(Some(path)) = given.try_get_one::<PathBuf>(OPTION) else {
        return Ok(FromFile::default());
    };
    let fail = |why: String| format!("{}: {}", path.display(), why.trim());
    let text = read_small(path).map_err(|error| fail(error.to_string()))?;
    let table: Table = text
        .parse()
        .map_err(|error: toml::de::Error| fail(error.to_string()))?;
    let mut from = FromFile {
        path: path.clone(),
        options: BTreeSet::new(),
    };
    // `check` takes the file of `core` or `proxy`, with options that it does not have itself.
    let own = name.unwrap_or(command);
    let others = ["core", "proxy"].map(|name| command.find_subcommand(name));
    let others = others.into_iter().flatten();
    let readers: Vec<_> = match own.get_name() {
        "check" => std::iter::once(own).chain(others).collect(),
        _ => vec![own],
    };
    let mut added = Vec::new();
    for (key, value) in &table {
        let known = readers
            .iter()
            .find_map(|&reader| Some((reader, option(reader, key)?)));
        let (reader, option) = known.ok_or_else(|| fail(unknown(command, own, key)))?;
        let of_key = option_words(option, key, value).map_err(fail)?;
        validate(reader, &of_key).map_err(|why| fail(format!("`{key}`: {why}")))?;
        let source = given.try_contains_id(option.get_id().as_str());
        let source = source
            .ok()
            .and_then(|_| given.value_source(option.get_id().as_str()));
        let is_given = matches!(
            source,
            Some(ValueSource::CommandLine | ValueSource::EnvVariable)
        );
        if std::ptr::eq(reader, own) && !is_given {
            from.options.insert(option.get_id().clone());
            added.extend(of_key.into_iter().map(OsString::from));
        }
    }
    words.splice(at..at, added);
    Ok(from)
}

/// The option with the long name `key`, if a file may set it.
fn option<'a>(command: &'a Command, key: &str) -> Option<&'a Arg> {
    let mut options = command.get_arguments();
    options.find(|option| option.get_long() == Some(key) && key != OPTION)
}

/// Why `own`, a command of `root`, does not know `key`, with the nearest key that it knows.
fn unknown(root: &Command, own: &Command, key: &str) -> String {
    let mut commands = root.get_subcommands();
    let serves = |command: &&Command| ["core", "proxy"].contains(&command.get_name());
    if let Some(other) = commands.find(|other| serves(other) && option(other, key).is_some()) {
        return format!("`{key}` is an option of `rosrescue {}`", other.get_name());
    }
    let words = [own.get_name(), &format!("--{key}")];
    let hint = match without_environment(own).try_get_matches_from(words) {
        Err(error) => error.get(ContextKind::SuggestedArg).cloned(),
        Ok(_) => None,
    };
    match hint {
        Some(ContextValue::String(hint)) if hint != "--config" => {
            let hint = hint.trim_start_matches('-');
            format!("unknown key `{key}`; did you mean `{hint}`?")
        }
        _ => format!("unknown key `{key}`; the keys are the long options, without `--`"),
    }
}

/// `key = value` as words of the command line.
fn option_words(option: &Arg, key: &str, value: &Value) -> Result<Vec<String>, String> {
    let word = |value: &Value| match value {
        Value::String(text) => Ok(format!("--{key}={text}")),
        Value::Integer(number) => Ok(format!("--{key}={number}")),
        Value::Float(number) => Ok(format!("--{key}={number}")),
        _ => Err(format!("`{key}` must be a text or a number")),
    };
    match value {
        Value::Boolean(true) if !option.get_action().takes_values() => Ok(vec![format!("--{key}")]),
        Value::Boolean(false) if !option.get_action().takes_values() => Ok(Vec::new()),
        _ if !option.get_action().takes_values() => Err(format!("`{key}` must be true or false")),
        Value::Array(values) => values.iter().map(word).collect(),
        _ => Ok(vec![word(value)?]),
    }
}

/// Checks the words of one option by themselves.
fn validate(command: &Command, words: &[String]) -> Result<(), String> {
    let all = std::iter::once(command.get_name()).chain(words.iter().map(String::as_str));
    match without_environment(command).try_get_matches_from(all) {
        Err(error) if error.kind() != ErrorKind::MissingRequiredArgument => {
            let text = error.to_string();
            let line = text.lines().next().unwrap_or_default();
            Err(line.trim_start_matches("error: ").to_owned())
        }
        _ => Ok(()),
    }
}

fn without_environment(command: &Command) -> Command {
    command.clone().mut_args(|option| option.env(None::<&str>))
}

/// All options of `core`, or of `proxy` if there is a master, as `check` with the options `checked` sees them.
pub(super) fn settings(
    command: &Command,
    checked: &ArgMatches,
    file: &FromFile,
) -> Result<Vec<OptionValue>, String> {
    let has_master = matches!(checked.try_contains_id("master"), Ok(true));
    let name = if has_master { "proxy" } else { "core" };
    let Some(target) = command.find_subcommand(name) else {
        return Ok(Vec::new());
    };
    let mut words = vec![OsString::from("rosrescue"), name.into()];
    for option in target.get_arguments() {
        let id = option.get_id().as_str();
        let is_checked = matches!(checked.try_contains_id(id), Ok(true));
        let is_typed = is_checked && checked.value_source(id) == Some(ValueSource::CommandLine);
        if let Some(long) = option
            .get_long()
            .filter(|_| is_typed && !file.options.contains(option.get_id()))
        {
            for value in checked.get_raw(id).into_iter().flatten() {
                words.push(format!("--{long}={}", value.to_string_lossy()).into());
            }
        }
    }
    let file = insert(command, &mut words)?;
    let matches = command
        .clone()
        .ignore_errors(true)
        .try_get_matches_from(words);
    let Ok(Some((_, matches))) = matches.as_ref().map(ArgMatches::subcommand) else {
        return Ok(Vec::new());
    };
    let options = target.get_arguments().filter_map(|option| {
        let id = option.get_id().as_str();
        let values = matches.try_get_raw(id).ok()?.into_iter().flatten();
        let values: Vec<_> = values.map(|value| value.to_string_lossy()).collect();
        let source = match matches.value_source(id) {
            Some(ValueSource::CommandLine) if file.options.contains(option.get_id()) => {
                file.path.display().to_string()
            }
            Some(ValueSource::CommandLine) => "command line".to_owned(),
            Some(ValueSource::EnvVariable) => "environment".to_owned(),
            _ => "default".to_owned(),
        };
        Some(OptionValue {
            option: option.get_long()?.to_owned(),
            value: (!values.is_empty()).then(|| values.join(",")),
            source,
        })
    });
    Ok(options.collect())
}

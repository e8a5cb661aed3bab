//! Finds launch files that send nodes to a master by its address.

use std::{
    collections::BTreeSet,
    fs,
    path::PathBuf,
    time::{Duration, Instant},
};

use quick_xml::{XmlVersion, events::Event, reader::Reader};

use super::units;

const VARIABLE: &str = "ROS_MASTER_URI";
/// Maximum number of launch files that are read.
const FILES_MOST: usize = 4000;
/// How long the search may take.
const TIME_MOST: Duration = Duration::from_secs(1);

/// What the launch files of all packages contain.
#[derive(Clone, Debug, Default)]
pub(super) struct Launches {
    /// Number of files that were read.
    pub(super) files: usize,
    pub(super) settings: Vec<Setting>,
    /// Whether the search stopped at its limits.
    pub(super) is_cut: bool,
}

/// An `<env>` that sets `ROS_MASTER_URI`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Setting {
    pub(super) file: PathBuf,
    /// Line number, counted from 1.
    pub(super) line: usize,
    /// The value as it is written in the file, with substitutions such as `$(arg robot)`.
    pub(super) uri: String,
}

/// Reads all `*.launch` files below the folders of `package_path`, the value of `ROS_PACKAGE_PATH`. Follows symbolic
/// links, as rospack does.
pub(super) fn find(package_path: &str) -> Launches {
    let start = Instant::now();
    let mut found = Launches::default();
    let roots = package_path.split(':').filter(|root| !root.is_empty());
    let mut folders: Vec<_> = roots.rev().map(PathBuf::from).collect();
    let mut seen = BTreeSet::new();
    while let Some(folder) = folders.pop() {
        let Ok(folder) = folder.canonicalize() else {
            continue;
        };
        if !seen.insert(folder.clone()) {
            continue;
        }
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            if found.files >= FILES_MOST || start.elapsed() >= TIME_MOST {
                found.is_cut = true;
                return found;
            }
            let (name, file) = (entry.file_name(), entry.path());
            if file.extension().is_some_and(|end| end == "launch") && file.is_file() {
                found.files += 1;
                let settings = master_uris(&units::read(&file)).into_iter();
                let settings = settings.map(|(line, uri)| Setting {
                    file: file.clone(),
                    line,
                    uri,
                });
                found.settings.extend(settings);
            } else if !name.as_encoded_bytes().starts_with(b".")
                && entry.file_type().is_ok_and(|kind| !kind.is_file())
                && file.is_dir()
            {
                folders.push(file);
            }
        }
    }
    found
}

/// Finds line and value of each `<env>` that sets `ROS_MASTER_URI`, up to the first XML error. Leaves out those that
/// only pass the variable on.
fn master_uris(launch: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    if !launch.contains(VARIABLE) {
        return found;
    }
    let mut reader = Reader::from_str(launch);
    loop {
        let begin = usize::try_from(reader.buffer_position()).unwrap_or_default();
        match reader.read_event() {
            Ok(Event::Start(tag) | Event::Empty(tag)) if tag.name().as_ref() == "env" => {
                let value = |name| {
                    let attribute = tag.try_get_attribute(name).ok()??;
                    let value = attribute.normalized_value(XmlVersion::Implicit1_0);
                    Some(value.ok()?.into_owned())
                };
                if value("name").as_deref() == Some(VARIABLE)
                    && let Some(uri) = value("value")
                    && !uri.contains(VARIABLE)
                {
                    let before = launch.get(..begin).unwrap_or_default();
                    found.push((before.matches('\n').count() + 1, uri));
                }
            }
            Ok(Event::Eof) | Err(_) => return found,
            Ok(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_master_that_a_launch_file_names_is_found_with_its_line() {
        let launch = r#"<?xml version="1.0"?>
<launch>
  <!-- <env name="ROS_MASTER_URI" value="http://comment:11311"/> -->
  <env name="ROS_MASTER_URI" value="http://a:11311"/>
  <node pkg="p" type="t" name="n">
    <env
        value='http://$(arg robot):11311' name="ROS_MASTER_URI"></env>
    <env name="OTHER" value="http://other:11311"/>
    <env name="ROS_MASTER_URI" value="$(optenv ROS_MASTER_URI http://b:11311)"/>
  </node>
  <env name="ROS_MASTER_URI" value="http://é&amp;c:1"/>
  </wrong>
  <env name="ROS_MASTER_URI" value="http://late:11311"/>"#;
        let found = |line, uri: &str| (line, uri.to_owned());
        assert_eq!(
            master_uris(launch),
            [
                found(4, "http://a:11311"),
                found(6, "http://$(arg robot):11311"),
                found(11, "http://é&c:1"),
            ]
        );
        assert_eq!(master_uris("<env name='ROS_MASTER_URI'"), []);
    }

    #[test]
    fn launch_files_of_all_packages_are_read_once() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().canonicalize().unwrap();
        let launch = root.join("src/robot/launch");
        fs::create_dir_all(&launch).unwrap();
        fs::create_dir(root.join("src/.git")).unwrap();
        let text = "<launch>\n<env name='ROS_MASTER_URI' value='http://a:1'/></launch>";
        for file in [
            "src/robot/launch/a.launch",
            "src/.git/b.launch",
            "src/c.txt",
        ] {
            fs::write(root.join(file), text).unwrap();
        }
        // A link that leads back to its parent.
        std::os::unix::fs::symlink(&root, launch.join("up")).unwrap();
        let path = format!("{0}/src:{0}/none::{0}", root.display());
        let found = find(&path);
        let setting = Setting {
            file: launch.join("a.launch"),
            line: 2,
            uri: "http://a:1".to_owned(),
        };
        assert_eq!((found.files, found.is_cut), (1, false));
        assert_eq!(found.settings, [setting]);
    }
}

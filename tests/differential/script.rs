//! A sequence of calls as data. It can be played, printed, read back and made shorter.

use ros1_master::xmlrpc::{Call, Struct, Value};
use serde_json::{Map, Value as Json, json};

/// A step of a sequence.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Step {
    /// A call on one of the clients' connections.
    Call {
        /// The client.
        by: usize,
        /// The call, with the placeholders of [`node_api`] for addresses of nodes.
        call: Call,
    },
    /// The master is killed: between two calls, or while the next one is running.
    Crash {
        /// Whether it is killed while the next call is running.
        in_flight: bool,
    },
    /// The master is killed, and stays away until [`Step::Back`].
    Away,
    /// A master starts.
    Back,
    /// The leader hands over to another computer. Without effect on a single computer.
    Handover {
        /// Whether it hands over while the next call is running.
        in_flight: bool,
    },
    /// The state is brought to a new master that has answered these calls before. The sequence continues with that
    /// master.
    Successor(Vec<Call>),
}

/// A whole sequence.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Script {
    /// Whether values occur that a master cannot return. Then callbacks cannot be predicted.
    pub(crate) unreturnable: bool,
    pub(crate) steps: Vec<Step>,
}

/// Placeholder for the address of a listening node, which differs in each run.
pub(crate) fn node_api(index: usize) -> String {
    format!("http://node{index}/")
}

/// `call` with real addresses.
pub(crate) fn with_real_apis(call: &Call, apis: &[String]) -> Call {
    let params = call.params.iter().map(|value| real_value(value, apis));
    Call::new(call.method.as_str(), params.collect())
}

fn real_value(value: &Value, apis: &[String]) -> Value {
    match value {
        Value::String(text) => {
            let index = (0..apis.len()).find(|index| node_api(*index) == *text);
            index.map_or_else(|| value.clone(), |index| apis[index].as_str().into())
        }
        Value::Array(elements) => {
            Value::Array(elements.iter().map(|it| real_value(it, apis)).collect())
        }
        Value::Struct(members) => {
            let members = members.iter();
            Value::Struct(
                members
                    .map(|(name, it)| (name.clone(), real_value(it, apis)))
                    .collect(),
            )
        }
        other => other.clone(),
    }
}

impl Script {
    /// Prints one line per step. [`Script::parse`] reads them.
    pub(crate) fn print(&self) -> String {
        let mut text = String::new();
        if self.unreturnable {
            text += "unreturnable\n";
        }
        for step in &self.steps {
            match step {
                Step::Call { by, call } => text += &format!("{by} {}\n", call_to_json(call)),
                Step::Crash { in_flight: true } => text += "crash in flight\n",
                Step::Crash { in_flight: false } => text += "crash\n",
                Step::Handover { in_flight: true } => text += "handover in flight\n",
                Step::Handover { in_flight: false } => text += "handover\n",
                Step::Away => text += "away\n",
                Step::Back => text += "back\n",
                Step::Successor(found) => {
                    text += "successor\n";
                    for call in found {
                        text += &format!("+ {}\n", call_to_json(call));
                    }
                }
            }
        }
        text
    }

    /// Reverses [`Script::print`]. Skips empty lines and lines that begin with `#`.
    pub(crate) fn parse(text: &str) -> Self {
        let mut unreturnable = false;
        let mut steps = Vec::new();
        for line in text.lines().map(str::trim) {
            match line {
                "" => {}
                _ if line.starts_with('#') => {}
                "unreturnable" => unreturnable = true,
                "crash" => steps.push(Step::Crash { in_flight: false }),
                "crash in flight" => steps.push(Step::Crash { in_flight: true }),
                "handover" => steps.push(Step::Handover { in_flight: false }),
                "handover in flight" => steps.push(Step::Handover { in_flight: true }),
                "away" => steps.push(Step::Away),
                "back" => steps.push(Step::Back),
                "successor" => steps.push(Step::Successor(Vec::new())),
                _ => {
                    let (by, call) = line.split_once(' ').expect("a client and a call");
                    let call = call_from_json(&serde_json::from_str(call).expect(line));
                    match (by, steps.last_mut()) {
                        ("+", Some(Step::Successor(found))) => found.push(call),
                        ("+", _) => panic!("no successor before {line}"),
                        _ => steps.push(Step::Call {
                            by: by.parse().expect(line),
                            call,
                        }),
                    }
                }
            }
        }
        Self {
            unreturnable,
            steps,
        }
    }

    pub(crate) fn calls(&self) -> usize {
        let calls = self.steps.iter().map(|step| match step {
            Step::Call { .. } => 1,
            Step::Crash { .. } | Step::Handover { .. } | Step::Away | Step::Back => 0,
            Step::Successor(found) => found.len(),
        });
        calls.sum()
    }
}

/// Simpler versions of a step: a multicall or a successor without one of its entries.
pub(crate) fn simpler(step: &Step) -> Vec<Step> {
    match step {
        Step::Call { by, call } => match call.params.as_slice() {
            [Value::Array(entries)] if call.method == "system.multicall" => (0..entries.len())
                .map(|index| {
                    let mut fewer = entries.clone();
                    fewer.remove(index);
                    Step::Call {
                        by: *by,
                        call: Call::new(call.method.as_str(), vec![Value::Array(fewer)]),
                    }
                })
                .collect(),
            _ => Vec::new(),
        },
        Step::Successor(found) => (0..found.len())
            .map(|index| {
                let mut fewer = found.clone();
                fewer.remove(index);
                Step::Successor(fewer)
            })
            .collect(),
        Step::Crash { .. } | Step::Handover { .. } | Step::Away | Step::Back => Vec::new(),
    }
}

/// Removes as much from `whole` as possible while it still `fails`, which is called at most `patience` times. Removes
/// halves first, then smaller pieces, then parts of the items.
pub(crate) fn shrink<T: Clone>(
    whole: &[T],
    simpler: impl Fn(&T) -> Vec<T>,
    mut patience: usize,
    mut fails: impl FnMut(&[T]) -> bool,
) -> Vec<T> {
    let mut rest = whole.to_vec();
    let mut fails = |items: &[T]| {
        patience = patience.saturating_sub(1);
        patience > 0 && fails(items)
    };
    let mut piece = rest.len().div_ceil(2);
    while piece > 0 {
        let mut removed = false;
        let mut end = rest.len();
        // Begins at the end: late items rarely affect earlier ones.
        while end > 0 {
            let start = end.saturating_sub(piece);
            let mut fewer = rest.clone();
            fewer.drain(start..end);
            if fails(&fewer) {
                rest = fewer;
                removed = true;
            }
            end = start;
        }
        if !removed || piece > 1 {
            piece = if piece == 1 { 0 } else { piece.div_ceil(2) };
        }
    }
    let mut index = 0;
    while let Some(item) = rest.get(index) {
        let better = simpler(item).into_iter().find_map(|item| {
            let mut other = rest.clone();
            other[index] = item;
            fails(&other).then_some(other)
        });
        match better {
            Some(other) => rest = other,
            None => index += 1,
        }
    }
    rest
}

fn call_to_json(call: &Call) -> Json {
    let params = call.params.iter().map(to_json);
    Json::Array(
        std::iter::once(Json::from(call.method.as_str()))
            .chain(params)
            .collect(),
    )
}

fn call_from_json(json: &Json) -> Call {
    let (method, params) = json.as_array().expect("a call").split_first().unwrap();
    let params = params.iter().map(from_json).collect();
    Call::new(method.as_str().expect("a method"), params)
}

/// Converts a value. Types that JSON lacks become an object with one member that is named after the type.
fn to_json(value: &Value) -> Json {
    match value {
        Value::Nil => Json::Null,
        Value::Bool(truth) => json!(truth),
        Value::Int(number) => json!(number),
        Value::BigInt(digits) => json!({ "int": digits }),
        Value::BigDecimal(text) => json!({ "decimal": text }),
        Value::Double(number) => json!({ "double": format!("{number:?}") }),
        Value::String(text) => json!(text),
        Value::DateTime(text) => json!({ "date": text }),
        Value::Base64(bytes) => json!({ "base64": bytes }),
        Value::Array(elements) => elements.iter().map(to_json).collect(),
        Value::Struct(members) => {
            let members = members.iter();
            let members: Map<String, Json> = members
                .map(|(name, value)| (name.clone(), to_json(value)))
                .collect();
            json!({ "struct": members })
        }
    }
}

fn from_json(json: &Json) -> Value {
    match json {
        Json::Null => Value::Nil,
        Json::Bool(truth) => (*truth).into(),
        Json::Number(number) => i32::try_from(number.as_i64().unwrap()).unwrap().into(),
        Json::String(text) => text.as_str().into(),
        Json::Array(elements) => Value::Array(elements.iter().map(from_json).collect()),
        Json::Object(members) => {
            let (kind, value) = members.iter().next().expect("a type");
            let text = || value.as_str().expect(kind).to_owned();
            match kind.as_str() {
                "int" => Value::BigInt(text()),
                "decimal" => Value::BigDecimal(text()),
                "double" => Value::Double(text().parse().unwrap()),
                "date" => Value::DateTime(text()),
                "base64" => {
                    let bytes = value.as_array().unwrap().iter();
                    Value::Base64(
                        bytes
                            .map(|it| u8::try_from(it.as_u64().unwrap()).unwrap())
                            .collect(),
                    )
                }
                "struct" => {
                    let members = value.as_object().unwrap().iter();
                    Value::Struct(
                        members
                            .map(|(name, value)| (name.clone(), from_json(value)))
                            .collect::<Struct>(),
                    )
                }
                _ => panic!("no type {kind}"),
            }
        }
    }
}

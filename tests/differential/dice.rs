//! Random calls with few names and values, so that they collide often.

use ros1_master::xmlrpc::{Call, Struct, Value};

use crate::support::unordered;

/// A splitmix64 random number generator.
pub(crate) struct Dice(pub(crate) u64);

/// The possible contents of the calls of one sequence.
pub(crate) struct Cast {
    /// The nodes' addresses.
    pub(crate) apis: Vec<String>,
    /// Whether values occur that a master cannot return.
    pub(crate) unreturnable: bool,
    /// Whether parameters may have the wrong type or number, and multicalls may be malformed.
    pub(crate) errors: bool,
    /// Whether calls ask the master for its process id.
    pub(crate) process: bool,
}

pub(crate) const CALLERS: &[&str] = &[
    "/n0", "/n1", "/n2", "/n0", "/n1", "/n2", "/ns/n3", "/ns/n3", "plain", "a/b", "", "/a//b",
    "/x/", "/o d",
];
pub(crate) const NAMES: &[&str] = &[
    "/t0", "/t1", "/t2", "/t3", "/t4", "/t5", "/ns/t6", "t0", "t7", "~t", "/t0/", "//t1//", "/n0/t",
];
const ODD_NAMES: &[&str] = &[
    "//", "~", "/", "", "a b", "a:b", "é/ü", "~~", "~/x", "t/~", "/*",
];
pub(crate) const KEYS: &[&str] = &[
    "/a", "/a/b", "/a/b/c", "/a/d", "/b", "/b/c/", "a", "~p", "/ns/p", "//a//b", "/d/e/f/g", "c",
];
const ODD_KEYS: &[&str] = &[
    "/", "//", "~", "", "a b", "a:b/c", "~/a", "b~", "/é", "/a/~b", "/a//",
];
const MEMBERS: &[&str] = &[
    "a", "b", "c", "d", "x", "b/c", "/a", "", "~p", "é", "it's/c", "c/", "/€",
];
const TYPES: &[&str] = &["a/B", "a/C", "*"];
const ODD_TYPES: &[&str] = &["", "a", "a/b/C", "/", " / "];
const READS: &[&str] = &[
    "getSystemState",
    "getTopicTypes",
    "getParamNames",
    "getPid",
    "getUri",
];
#[rustfmt::skip]
const NO_METHODS: &[&str] = &[
    "nope", "uri", "done", "topics_types", "param_update_task", "system.listMethods", "_shutdown",
    "shutdown", "", "getParam.x", "reg_manager", "thread_pool", "ps_lock", "publishers",
    "services", "param_subscribers", "param_server",
];

impl Dice {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(crate) fn below(&mut self, end: usize) -> usize {
        usize::try_from(self.next() % end as u64).unwrap()
    }

    /// True once in `n` times.
    pub(crate) fn once_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    pub(crate) fn pick<'a, T: ?Sized>(&mut self, from: &[&'a T]) -> &'a T {
        from[self.below(from.len())]
    }

    fn odd(&mut self, usual: &[&'static str], odd: &[&'static str]) -> Value {
        if self.once_in(8) {
            self.pick(odd)
        } else {
            self.pick(usual)
        }
        .into()
    }

    fn api(&mut self, cast: &Cast, caller: &str) -> Value {
        if cast.errors && self.once_in(30) {
            return self
                .pick(&["", "https://h", "h:1", "rosrpc://", "http://"])
                .into();
        }
        // Most nodes have one address, so that few nodes are displaced.
        let nodes = cast.apis.len();
        let usual = caller.bytes().map(usize::from).sum::<usize>() % nodes;
        let index = if self.once_in(12) {
            self.below(nodes)
        } else {
            usual
        };
        cast.apis[index].as_str().into()
    }

    pub(crate) fn value(&mut self, cast: &Cast, levels: usize) -> Value {
        let kinds = if levels == 0 { 8 } else { 13 };
        match self.below(kinds) {
            0 => i32::try_from(self.below(5)).unwrap().into(),
            1 => self.once_in(2).into(),
            2 => [0.0, -0.0, 1.5, 1e300, f64::NAN, 5e-324, -1e16][self.below(7)].into(),
            3 => self
                .pick(&["", "x", "b", "<&>\"'", " \n\t", "é\u{1F600}", "/a"])
                .into(),
            4 => Value::DateTime(self.pick(&["20200101T00:00:00", "b", "now"]).to_owned()),
            5 => Value::Base64(vec![0, 255, 10][..self.below(4)].to_vec()),
            6 | 7 if cast.unreturnable && self.once_in(3) => match self.below(2) {
                0 => Value::Nil,
                1 if !unordered() && self.once_in(3) => Value::BigDecimal("1.5".to_owned()),
                _ => Value::BigInt(
                    self.pick(&["2147483648", "-5000000000", "99999999999999999999"])
                        .to_owned(),
                ),
            },
            6 | 7 => Value::Int([i32::MAX, i32::MIN, -1][self.below(3)]),
            8 | 9 => {
                let len = self.below(4);
                Value::Array((0..len).map(|_| self.value(cast, levels - 1)).collect())
            }
            _ => {
                let len = self.below(5);
                let members = (0..len).map(|_| {
                    let key = self.pick(MEMBERS).to_owned();
                    (key, self.value(cast, levels - 1))
                });
                Value::Struct(members.collect::<Struct>())
            }
        }
    }

    /// A call of any kind.
    pub(crate) fn call(&mut self, cast: &Cast, levels: usize) -> Call {
        let caller = match self.pick(CALLERS) {
            // Only the node itself can use its name as a topic. While it is registered, no helper can restore the type
            // of a topic with that name.
            "/o d" if !cast.process => "/x/",
            caller => caller,
        };
        let mut params: Vec<Value> = vec![caller.into()];
        let method = match self.below(if levels == 0 { 100 } else { 112 }) {
            0..=15 => {
                params.extend([
                    self.odd(NAMES, ODD_NAMES),
                    self.odd(TYPES, ODD_TYPES),
                    self.api(cast, caller),
                ]);
                "registerPublisher"
            }
            16..=30 => {
                params.extend([
                    self.odd(NAMES, ODD_NAMES),
                    self.odd(TYPES, ODD_TYPES),
                    self.api(cast, caller),
                ]);
                "registerSubscriber"
            }
            31..=38 => {
                let service_api = self
                    .pick(&["rosrpc://h:1", "rosrpc://h:2", "http://h"])
                    .into();
                params.extend([
                    self.odd(NAMES, ODD_NAMES),
                    service_api,
                    self.api(cast, caller),
                ]);
                "registerService"
            }
            39..=44 => {
                params.extend([self.odd(NAMES, ODD_NAMES), self.api(cast, caller)]);
                "unregisterPublisher"
            }
            45..=50 => {
                params.extend([self.odd(NAMES, ODD_NAMES), self.api(cast, caller)]);
                "unregisterSubscriber"
            }
            51..=54 => {
                let service_api = self
                    .pick(&["rosrpc://h:1", "rosrpc://h:2", "http://h"])
                    .into();
                params.extend([self.odd(NAMES, ODD_NAMES), service_api]);
                "unregisterService"
            }
            55..=66 => {
                params.extend([self.odd(KEYS, ODD_KEYS), self.value(cast, 3)]);
                "setParam"
            }
            67..=71 => {
                params.push(self.odd(KEYS, ODD_KEYS));
                "deleteParam"
            }
            72..=77 => {
                params.extend([self.api(cast, caller), self.odd(KEYS, ODD_KEYS)]);
                "subscribeParam"
            }
            78..=80 => {
                params.extend([self.api(cast, caller), self.odd(KEYS, ODD_KEYS)]);
                "unsubscribeParam"
            }
            81..=90 => {
                params.push(self.odd(KEYS, ODD_KEYS));
                self.pick(&["getParam", "hasParam", "searchParam"])
            }
            91..=94 => {
                params.push(self.odd(NAMES, ODD_NAMES));
                self.pick(&["lookupService", "getPublishedTopics"])
            }
            95 => {
                params.push(self.odd(CALLERS, ODD_NAMES));
                "lookupNode"
            }
            96..=98 => match self.pick(READS) {
                "getPid" if !cast.process => "getUri",
                read => read,
            },
            99 => {
                // A `shutdown` with two parameters would succeed.
                params.truncate(self.below(2));
                self.pick(NO_METHODS)
            }
            _ => return self.multicall(cast, levels - 1),
        };
        let stays = NO_METHODS.contains(&method);
        if cast.errors && !stays && self.once_in(12) {
            self.spoil(cast, &mut params);
        }
        Call::new(method, params)
    }

    fn spoil(&mut self, cast: &Cast, params: &mut Vec<Value>) {
        match self.below(4) {
            0 => params.push(self.value(cast, 1)),
            1 => drop(params.pop()),
            _ => {
                let index = self.below(params.len());
                params[index] = match self.value(cast, 2) {
                    // rosmaster would accept it like the type `*` and keep it as a date.
                    Value::DateTime(_) => Value::Nil,
                    value => value,
                };
            }
        }
    }

    /// Reads and writes in a few namespaces, which affect each other within one multicall.
    fn churn(&mut self, cast: &Cast) -> Call {
        let key = self.pick(&["/a", "/a/b", "/a/b/c", "/"]).into();
        let mut params = vec!["/n0".into(), key];
        let method = match self.below(6) {
            0 | 1 => "getParam",
            2 => "deleteParam",
            3 => {
                params.insert(1, self.api(cast, "/n0"));
                "subscribeParam"
            }
            _ => {
                params.push(self.value(cast, 3));
                "setParam"
            }
        };
        Call::new(method, params)
    }

    fn multicall(&mut self, cast: &Cast, levels: usize) -> Call {
        let len = self.below(7);
        let churns = self.once_in(3);
        let calls: Vec<_> = (0..len)
            .map(|_| {
                if churns {
                    self.churn(cast)
                } else {
                    self.call(cast, levels)
                }
            })
            .collect();
        let mut call = Call::multicall(calls);
        if cast.errors
            && self.once_in(4)
            && let Some(Value::Array(entries)) = call.params.first_mut()
            && !entries.is_empty()
        {
            let index = self.below(entries.len());
            let Value::Struct(entry) = &mut entries[index] else {
                unreachable!()
            };
            match self.below(7) {
                0 => drop(entry.shift_remove("params")),
                1 => drop(entry.shift_remove("methodName")),
                2 => entries[index] = self.value(cast, 2),
                3 | 4 => {
                    // Calling an attribute that is not a method returns the attribute's own text.
                    let callable = entry["methodName"]
                        .as_str()
                        .is_none_or(|name| !NO_METHODS.contains(&name));
                    if callable {
                        let params = match self.value(cast, 1) {
                            Value::BigInt(_) | Value::BigDecimal(_) | Value::Nil => Value::Int(1),
                            // rosmaster takes the keys for parameters, in an order that only its Python knows.
                            Value::Struct(mut keys) if unordered() => {
                                keys.truncate(1);
                                Value::Struct(keys)
                            }
                            value => value,
                        };
                        entry.insert("params".to_owned(), params);
                    }
                }
                5 => {
                    let name = match self.value(cast, 1) {
                        Value::String(_) => Value::Int(5),
                        value => value,
                    };
                    entry.insert("methodName".to_owned(), name);
                }
                _ => call.params = vec![self.value(cast, 1)],
            }
        }
        call
    }
}

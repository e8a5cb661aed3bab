// A node of rosnodejs. tests/field/clients/measure.py describes what it does and prints.
const rosnodejs = require("rosnodejs");

const [name] = process.argv.slice(2);
const say = (...words) => console.log(words.join(" "));

// Runs `act` every 200 ms, one at a time, and prints how long it took.
async function forever(what, act) {
  for (let number = 1; ; number += 1) {
    const start = Date.now();
    try {
      await act(number);
      say(what, number, Date.now() - start);
    } catch (error) {
      say(`${what}-failed`, number, Date.now() - start, String(error).replaceAll("\n", " "));
    }
    await new Promise((wake) => setTimeout(wake, 200));
  }
}

async function main() {
  const node = await rosnodejs.initNode(`/${name}`, { onTheFly: true });
  node._node.on("shutdown", () => say("shutdown"));
  const text = rosnodejs.require("std_msgs").msg.String;
  const { Trigger } = rosnodejs.require("std_srvs").srv;
  const out = node.advertise(`/${name}/out`, text, { queueSize: 100 });
  node.subscribe(`/ref_${name}/out`, text, (message) => say("heard", message.data), { queueSize: 100, throttleMs: -1 });
  node.advertiseService(`/${name}/serve`, Trigger, (_request, response) => {
    response.success = true;
    return true;
  });
  let number = 0;
  setInterval(() => out.publish({ data: String((number += 1)) }), 100);
  say("ready");
  forever("param", async (value) => {
    await node.setParam(`/${name}/value`, value);
    const got = await node.getParam(`/${name}/value`);
    if (got !== value) throw new Error(`got ${got}`);
  });
  forever("call", async () => {
    const client = node.serviceClient(`/ref_${name}/serve`, Trigger);
    await client.call(new Trigger.Request());
  });
}

main();

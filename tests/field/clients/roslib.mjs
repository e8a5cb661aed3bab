// A client of rosbridge_websocket that uses roslib. tests/field/clients/measure.py describes what it does and prints.
const [folder, name, port] = process.argv.slice(2);
const { Param, Ros, Service, Topic } = await import(`${folder}/node_modules/roslib/dist/RosLib.js`);
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

const ros = new Ros({ url: `ws://127.0.0.1:${port}` });
await new Promise((connected) => ros.on("connection", connected));
const topic = (name) => new Topic({ ros, name, messageType: "std_msgs/String", queue_size: 100, queue_length: 100 });
const service = (name) => new Service({ ros, name, serviceType: "std_srvs/Trigger" });
topic(`/ref_${name}/out`).subscribe((message) => say("heard", message.data));
service(`/${name}/serve`).advertise((_request, response) => {
  response.success = true;
  response.message = "";
  return true;
});
const out = topic(`/${name}/out`);
out.advertise();
let number = 0;
setInterval(() => out.publish({ data: String((number += 1)) }), 100);
say("ready");
forever("call", () => new Promise((done, failed) => service(`/ref_${name}/serve`).callService({}, done, failed)));
forever("param", async (value) => {
  const param = new Param({ ros, name: `/${name}/value` });
  await new Promise((done, failed) => param.set(value, done, failed));
  const got = await new Promise((done, failed) => param.get(done, failed));
  if (got !== value) throw new Error(`got ${got}`);
});

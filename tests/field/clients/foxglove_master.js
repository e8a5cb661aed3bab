// The master of @foxglove/ros1 at the port that is given; the package has no other way to it than by its file.
const path = require("path");
const { HttpServerNodejs } = require("@foxglove/xmlrpc/nodejs");
const { RosMaster } = require(path.join(path.dirname(require.resolve("@foxglove/ros1")), "RosMaster.js"));

new RosMaster(new HttpServerNodejs()).start("127.0.0.1", Number(process.argv[2]));

// The master of @foxglove/ros1, at the given port. The package exports it only by its file.
const path = require("path");
const { HttpServerNodejs } = require("@foxglove/xmlrpc/nodejs");
const { RosMaster } = require(path.join(path.dirname(require.resolve("@foxglove/ros1")), "RosMaster.js"));

new RosMaster(new HttpServerNodejs()).start("127.0.0.1", Number(process.argv[2]));

// A viewer made of packages of other authors: Foxglove's own client of its WebSocket protocol, and protobufjs.
//
//     NODE_PATH=build/foxglove/node_modules node client.cjs URL SECONDS
//
// It subscribes to every channel and prints schemas, the newest message of each topic as JSON, and their numbers. The
// client checks nothing but the name of the subprotocol, which the SDK's server has renamed since.
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");
const protobuf = require("protobufjs");
require("protobufjs/ext/descriptor");

const SUBPROTOCOL = "foxglove.sdk.v1";
FoxgloveClient.SUPPORTED_SUBPROTOCOL = SUBPROTOCOL;
const [url, seconds] = process.argv.slice(2);
const client = new FoxgloveClient({ ws: new WebSocket(url, [SUBPROTOCOL]) });
const channels = new Map(), decoders = new Map(), newest = {}, counts = {}, schemas = {};

function decoder(channel) {
  if (channel.encoding === "json") return (data) => JSON.parse(new TextDecoder().decode(data));
  const files = protobuf.util.newBuffer(Buffer.from(channel.schema, "base64"));
  const type = protobuf.Root.fromDescriptor(files).lookupType(channel.schemaName);
  return (data) => type.toObject(type.decode(new Uint8Array(data.buffer, data.byteOffset, data.byteLength)), { longs: Number, enums: String });
}

client.on("error", (error) => { console.error(error); process.exit(1); });
client.on("advertise", (list) => {
  for (const channel of list) {
    const id = client.subscribe(channel.id);
    channels.set(id, channel);
    decoders.set(id, decoder(channel));
    schemas[channel.topic] = channel.schemaName;
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic } = channels.get(subscriptionId);
  newest[topic] = { stamp: Number(timestamp / 1000n), message: decoders.get(subscriptionId)(data) };
  counts[topic] = (counts[topic] ?? 0) + 1;
});
setTimeout(() => { console.log("RESULT " + JSON.stringify({ schemas, newest, counts })); process.exit(0); }, 1000 * Number(seconds));

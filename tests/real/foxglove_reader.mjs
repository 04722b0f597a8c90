// Reads a window with Foxglove's own libraries, as its viewer does: index, chunks with their checksums, every message by
// its schema. Prints a JSON document: for each topic its schema, how many messages, and what stands in the first.
//
//   node foxglove_reader.mjs WINDOW.mcap      where @mcap/* and @foxglove/* are installed beside this file
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { open } from "node:fs/promises";

const handle = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(handle),
  decompressHandlers: await loadDecompressHandlers(),
});

function decoderOf(channel) {
  const schema = reader.schemasById.get(channel.schemaId);
  if (channel.messageEncoding === "json") {
    return (data) => JSON.parse(new TextDecoder().decode(data));
  }
  if (channel.messageEncoding !== "cdr" || schema?.encoding !== "ros2msg") {
    throw new Error(`${channel.topic}: ${channel.messageEncoding} with ${schema?.encoding} is not known here`);
  }
  const cdr = new MessageReader(parse(new TextDecoder().decode(schema.data), { ros2: true }));
  return (data) => cdr.readMessage(data);
}

// Of an image, of a cloud, of the rest: what shows that the fields are where they belong.
function outline(message) {
  const { header, format, encoding, width, height, data, fields, point_step, distortion_model, k, transforms, status } = message;
  return {
    keys: Object.keys(message),
    frame: header?.frame_id,
    format: format ?? encoding,
    width, height, point_step, distortion_model,
    fields: fields?.map((field) => field.name),
    bytes: data?.length,
    fx: k?.[0],
    children: transforms?.map((transform) => transform.child_frame_id),
    levels: Array.isArray(status) ? status.map((one) => one.level) : undefined,
  };
}

const decoders = new Map();
const topics = {};
let last = 0n;
let inOrder = true;
for await (const { channelId, logTime, data } of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(channelId);
  if (!decoders.has(channelId)) {
    decoders.set(channelId, decoderOf(channel));
  }
  const message = decoders.get(channelId)(data);
  const topic = (topics[channel.topic] ??= {
    schema: reader.schemasById.get(channel.schemaId)?.name ?? null,
    encoding: channel.messageEncoding,
    messages: 0,
    first: outline(message),
  });
  topic.messages += 1;
  inOrder &&= logTime >= last;
  last = logTime;
}
const attachments = [];
for await (const attachment of reader.readAttachments({ validateCrcs: true })) {
  attachments.push(attachment.name);
}
await handle.close();
console.log(JSON.stringify({ profile: reader.header.profile, topics, attachments, inOrder }));

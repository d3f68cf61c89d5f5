// One upload by tus-js-client, as its options say: node tus_client.cjs SERVER FILE STORAGE OPTIONS
// Prints what happens, a JSON document a line.
const fs = require("node:fs");
const { PassThrough } = require("node:stream");
const tus = require("tus-js-client");

const [server, path, storage, text] = process.argv.slice(2);
const { stopAt, slowMs, previous, stream, ...options } = JSON.parse(text);
const tell = (what) => console.log(JSON.stringify(what));
// A pipe has no length that the client could look up; of a file it would promise whole chunks, the last one too
const pipe = () => fs.createReadStream(path).pipe(new PassThrough());
const source = stream ? pipe() : options.parallelUploads ? fs.createReadStream(path) : fs.readFileSync(path);
let lastAnswer = null;

const upload = new tus.Upload(source, {
  endpoint: `${server}/v1/uploads`,
  retryDelays: [200, 500, 1000, 2000, 4000, 8000, 8000, 8000, 8000],
  metadata: { filename: "large.zip" },
  urlStorage: new tus.FileUrlStorage(storage),
  fingerprint: async () => path,
  onAfterResponse: async (request, answer) => {
    lastAnswer = answer.getHeader("Splatpress-Scan") || lastAnswer;
    tell({ method: request.getMethod(), status: answer.getStatus(), offset: answer.getHeader("Upload-Offset") });
    if (slowMs) await new Promise((done) => setTimeout(done, slowMs));
  },
  onProgress: (sent) => { if (stopAt && sent >= stopAt) upload.abort().then(() => { tell({ stopped: sent }); process.exit(0); }); },
  onError: (error) => { tell({ error: String(error) }); process.exit(1); },
  onSuccess: () => { tell({ done: true, scan: lastAnswer, url: upload.url }); process.exit(0); },
  ...options,
});

(async () => {
  if (previous) {
    const found = await upload.findPreviousUploads();
    tell({ found: found.length });
    if (found.length) upload.resumeFromPreviousUpload(found[0]);
  }
  upload.start();
})();

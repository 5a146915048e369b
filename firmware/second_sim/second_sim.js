#!/usr/bin/env node
// SPDX-License-Identifier: Apache-2.0
// second_sim.js --board uno|megaatmega2560|pico FIRMWARE: see README.md for the operations.
"use strict";

const fs = require("fs");
const { Board } = require("./board");
const { Pico } = require("./pico");

const STDIN = 0, STDOUT = 1;
const HOLD_BYTES = 18;

function read(count) {
    const octets = Buffer.alloc(count);
    for (let done = 0, got; done < count; done += got) {
        got = fs.readSync(STDIN, octets, done, count - done, null);
        if (got === 0) process.exit(0); // the other end has closed the pipe
    }
    return octets;
}

function reply(op, content) {
    const header = Buffer.alloc(5);
    header.write(op, 0, "latin1");
    header.writeUInt32LE(content.length, 1);
    const octets = Buffer.concat([header, content]);
    for (let done = 0; done < octets.length; ) done += fs.writeSync(STDOUT, octets, done);
}

function packHolds(holds) {
    const octets = Buffer.alloc(holds.length * HOLD_BYTES);
    holds.forEach(([cycle, row, column, configuration, channel, code, settle], i) => {
        const at = i * HOLD_BYTES;
        octets.writeBigUInt64LE(BigInt(cycle), at);
        octets.set([row, column, configuration, channel], at + 8);
        octets.writeUInt16LE(code, at + 12);
        octets.writeUInt32LE(settle, at + 14);
    });
    return octets;
}

function holdLog(board, wish) {
    if (wish === 2) return packHolds(board.holds.splice(0));
    board.logging = wish === 1;
}

const OPERATIONS = {
    R: (board, content) => {
        board.run(Number(content.readBigUInt64LE()));
        return board.takeSent();
    },
    W: (board, content) => board.line.write(content),
    T: (board, content) => {
        board.setTable(Float64Array.from(board.table, (_, i) => content.readDoubleLE(8 * i)));
    },
    Z: (board) => board.restartCounters(),
    S: (board) => Buffer.from(JSON.stringify(board.stats())),
    L: (board, content) => holdLog(board, content[0]),
    E: (board) => Buffer.from(board.eeprom.memory),
    e: (board, content) => board.eeprom.memory.set(content.subarray(2), content.readUInt16LE()),
    X: (board) => board.reset(),
    J: (board, content) => board.jump(content.readUInt32LE()),
    P: (board) => board.cutPower(),
    F: (board) => board.restartByRom(),
    U: (board, content) => board.line.setOpen(content[0] !== 0),
    H: (board, content) => board.line.clearHalt(content[0]),
    V: (board) => Buffer.from(JSON.stringify(board.line.said())),
};

function main() {
    const given = process.argv.slice(2);
    const [flag, name] = given;
    const path = given.at(-1), pins = given[2] === "--pins" ? given[3] : undefined;
    if (flag !== "--board" || given.length !== (pins === undefined ? 3 : 5)) {
        console.error("usage: second_sim.js --board uno|megaatmega2560|pico [--pins PINS] FIRMWARE");
        process.exit(2);
    }
    const file = fs.readFileSync(path);
    const board = name === "pico" ? new Pico(file, pins) : new Board(name, file.toString("latin1"), pins);
    for (;;) {
        const header = read(5);
        const op = String.fromCharCode(header[0]);
        const content = read(header.readUInt32LE(1));
        const operation = OPERATIONS[op];
        if (operation) reply(op, Buffer.from(operation(board, content) ?? ""));
        else reply("!", Buffer.from(`this simulator has no operation '${op}'`));
    }
}

main();

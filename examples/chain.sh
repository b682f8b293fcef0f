#!/bin/sh
# From a recording to a drive on a bus: the chain of the paper as five commands.
#
#     sh examples/chain.sh FOLDER
#
# It writes log, nets, policy and the log of the drive to FOLDER. The simulated machine `machine`
# stands where a real one would: its frames go over UDP multicast. Fit and training take most of the
# time; HOURS, FIT_STEPS and TRAIN_STEPS change how much there is of each stage.
set -eu
path=$(cd "$(dirname "$0")/.." && pwd)/docs/rectangle.csv
bus="--interface udp_multicast --channel 239.74.163.2"
mkdir -p "$1" && cd "$1"

brokk-min collect --out log.npz --hours "${HOURS:-1}"
brokk-min fit log.npz --out net.npz --steps "${FIT_STEPS:-16000}"
brokk-min train --actuator net.npz --out policy.npz --total-steps "${TRAIN_STEPS:-400000}"
brokk-min evaluate --policy policy.npz --num-starts "${STARTS:-16}"
brokk-min machine $bus &
trap 'kill $!' EXIT
brokk-min drive --policy policy.npz $bus --command "${COMMANDS:-$path}" --log drive.log

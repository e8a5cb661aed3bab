# Runs keepalived on three computers, one of which leads. For `tests/robot/computers.rs`, after computers.sh and the start
# of three etcd servers.

# keepalived refuses to run a script that users other than root can change.
touch /run/rosrescue
ip addr add 10.0.0.9/24 dev switch # a computer without rosrescue

priority=103
for name in $computers; do
    own=${address[$name]}
    inside "$name" mount --bind "$ROSRESCUE" /run/rosrescue
    mkdir -p "$scratch/$name/etc/keepalived"
    # Change what the document says to change.
    sed "s|^\( *\)10.0.0.1$|\1first|; s|^\( *\)$own$|\110.0.0.1|; s|first|10.0.0.1|
        s|unicast_src_ip .*|unicast_src_ip $own|; s|priority .*|priority $priority|; s|/usr/bin/|/run/|" \
        "$REPOSITORY/packaging/keepalived/keepalived.conf" >"$scratch/$name/etc/keepalived/keepalived.conf"
    priority=$((priority - 1))
    inside "$name" env ROS_IP="$own" ROS_HOME="$scratch/$name" ROS_LOG_DIR="$scratch/$name" \
        ROS_MASTER_URI=http://localhost:11311 sh -c 'echo $$ >"$ROS_HOME/rosrescue.pid"; exec "$@"' sh \
        /run/rosrescue core --no-rosout --cluster "$cluster" >>"$scratch/$name/rosrescue.log" 2>&1 &
done
for name in $computers; do
    within 120 inside "$name" curl -fsS http://localhost:11311/ready
    inside "$name" keepalived --dont-fork --log-console \
        --pid="/run/$name.pid" --vrrp_pid="/run/$name.vrrp.pid" --checkers_pid="/run/$name.checkers.pid" \
        >>"$scratch/$name/keepalived.log" 2>&1 &
done

# Sets `holder` to the computer that answers at the virtual address.
ask() {
    local uri
    uri=$(curl -sS -m 0.2 -H 'Content-Type: text/xml' http://10.0.0.100:11311/ \
        -d '<methodCall><methodName>getUri</methodName><params><param><value>/x</value></param></params></methodCall>')
    for name in $computers; do
        case $uri in *"${address[$name]}:"*) holder=$name && return ;; esac
    done
    return 1
}
is_elsewhere() { ask && [ "$holder" != "$left" ]; }

# Waits until the address has moved to another computer, and prints how long that took.
moves() { # WHY
    # keepalived may move the address by itself before the connection is made.
    left=
    until [ "$left" = "$holder" ]; do
        left=$holder
        exec 3<>/dev/tcp/10.0.0.100/11311
        within 120 ask
    done
    local start=${EPOCHREALTIME/./}
    "$@"
    within 120 is_elsewhere
    echo "$*: from $left to $holder after $(((${EPOCHREALTIME/./} - start) / 1000)) ms"
    # A node that was connected must notice that its connection has ended.
    (printf 'GET /live HTTP/1.1\r\nHost: 10.0.0.100\r\n\r\n' >&3) || true
    timeout 10 cat <&3 >/dev/null 2>&1 || [ $? -ne 124 ]
    exec 3<&-
}
cut() { ip link set "$holder" down; }
stop() { kill "$(cat "$scratch/$holder/rosrescue.pid")"; }

within 120 ask
moves cut
cut_off=$left
moves stop
# The computer that was cut off comes back and does not disturb the others.
ip link set "$cut_off" up
left=nobody
within 120 is_elsewhere
